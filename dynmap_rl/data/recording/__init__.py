"""Recording of experts and of persons: plans of episodes, shards, and their merging."""
