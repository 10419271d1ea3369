"""Windows are pieces of episodes."""

import pytest
import torch
from tensordict import TensorDict

from dynmap_rl.data.windows import sample_windows


def test_windows_are_pieces_of_episodes():
    steps = torch.arange(20).expand(5, 20)
    episodes = TensorDict({"t": steps, "e": torch.arange(5)[:, None].expand(5, 20)}, [5, 20])
    windows = sample_windows(episodes, 32, 7, torch.Generator().manual_seed(0))
    assert windows.shape == (32, 7)
    assert (windows["t"].diff(dim=1) == 1).all()
    assert (windows["e"] == windows["e"][:, :1]).all()
    assert (windows["t"][::2, 0] == 0).all()
    assert len(windows["t"][1::2, 0].unique()) > 4
    assert sample_windows(episodes, 2, 20, torch.Generator()).shape == (2, 20)
    with pytest.raises(ValueError, match="21"):
        sample_windows(episodes, 2, 21, torch.Generator())


def test_every_start_is_drawn_and_a_part_is_that_of_the_whole_batch():
    episodes = TensorDict({"t": torch.arange(20).expand(5, 20)}, [5, 20])
    whole, part = (
        sample_windows(episodes, 64, 18, torch.Generator().manual_seed(0), part)["t"]
        for part in (slice(None), slice(1, None, 2))
    )
    assert set(whole[:, 0].tolist()) == {0, 1, 2}
    assert torch.equal(part, whole[1::2])


def test_single_windows_begin_everywhere():
    episodes, generator = TensorDict({"t": torch.arange(20).expand(5, 20)}, [5, 20]), torch.Generator()
    starts = torch.cat([sample_windows(episodes, 1, 7, generator)["t"][:, 0] for _ in range(400)])
    assert set(starts.tolist()) == set(range(14))
    assert 0.4 < (starts == 0).float().mean() < 0.7
