"""No network, no display, one thread; and one small recording that the tests of the data share."""

import os

os.environ["HF_HUB_OFFLINE"] = "1"
os.environ["SDL_VIDEODRIVER"] = "dummy"

import pytest
import torch

torch.set_num_threads(1)


def pytest_configure(config):
    config.addinivalue_line("markers", "slow: starts processes of its own; leave out with -m 'not slow'")


@pytest.fixture(scope="session")
def recording(tmp_path_factory):
    """A dataset of 4 + 2 demonstrations, in three shards; not to be written to."""
    from dynmap_rl.data import record_dataset, recording

    root = tmp_path_factory.mktemp("datasets") / "recording"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(recording, "SHARD_EPISODES", 2)
        return record_dataset(root, episodes=4, eval_episodes=2, workers=1)
