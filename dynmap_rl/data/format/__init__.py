"""LeRobot v3.0 datasets as files: reading, writing, adding columns, frames, the hub."""
