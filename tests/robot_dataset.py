"""A small robot dataset: a red square glides over a grey table, in frames of 96 x 128 pixels.

``python tests/robot_dataset.py FOLDER`` writes one of 30 episodes.
"""

import sys

import numpy as np

CAMERA = "observation.images.top"
FPS = 25
FEATURES = {
    "observation.state": {"dtype": "float32", "shape": (4,), "names": ["x", "y", "angle", "grip"]},
    "action": {"dtype": "float32", "shape": (2,), "names": ["vx", "vy"]},
}


def make_robot_dataset(root, lengths=(31, 47, 24, 33), videos=False, turns=3.0):
    """Write a dataset of squares that end in the middle of the table.

    The state is x, y (0..1 of the frame), an angle within -pi..pi that turns with up to ``turns`` rad/s, and a gripper
    that stays shut. Actions are velocities.
    """
    from dynmap_rl.data.format.quiet import quiet

    with quiet():
        from lerobot.datasets import LeRobotDataset

        camera = {
            "dtype": "video" if videos else "image",
            "shape": (96, 128, 3),
            "names": ["height", "width", "channels"],
        }
        features = {CAMERA: camera} | FEATURES
        dataset = LeRobotDataset.create("test/robot", FPS, features, root=root, use_videos=videos)
        rng = np.random.default_rng(0)
        for length in lengths:
            start, angle, rate = rng.uniform(0.15, 0.85, 2), rng.uniform(-3, 3), rng.uniform(-turns, turns)
            velocity = (0.5 - start) * FPS / length
            for t in range(length):
                position, turned = start + velocity * t / FPS, angle + rate * t / FPS
                state = [*position, np.arctan2(np.sin(turned), np.cos(turned)), 0]
                dataset.add_frame(
                    {
                        CAMERA: draw(position),
                        "observation.state": np.array(state, np.float32),
                        "action": velocity.astype(np.float32),
                        "task": "Glide to the middle.",
                    }
                )
            dataset.save_episode()
        dataset.finalize()
    return root


def draw(position):
    frame = np.full((96, 128, 3), 190, np.uint8)
    x, y = (position * [128, 96]).round().astype(int)
    frame[y - 7 : y + 7, x - 7 : x + 7] = 200, 30, 30
    return frame


def read_column(root, column):
    """Return a column of all files as float64 ``[rows, ...]``."""
    import pyarrow.parquet as pq

    tables = [
        pq.read_table(path, columns=["index", column]) for path in sorted((root / "data").rglob("*.parquet"))
    ]
    return np.concatenate([np.array(t[column].to_pylist(), np.float64) for t in tables])


if __name__ == "__main__":
    make_robot_dataset(sys.argv[1], np.random.default_rng(1).integers(30, 60, 30).tolist())
