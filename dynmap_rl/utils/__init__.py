"""Helpers without knowledge of environments, models or data: files, processes, devices, weights, hub, command line."""
