"""Recordings of experts and of persons, in shards that survive a kill."""
