"""LeRobot v3.0 datasets as files: reading, writing, further columns, frames, the hub."""
