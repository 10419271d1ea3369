import pytest
import torch

from dynmap_rl.modules.normalization import Normalizer


def test_normalizer_maps_the_range_to_plus_minus_one_and_back():
    normalizer = Normalizer([0.0, -2.0], [1.0, 4.0])
    assert normalizer.normalize(torch.tensor([[0.0, -2.0], [1.0, 4.0]])).tolist() == [[-1, -1], [1, 1]]
    x = torch.randn(5, 2)
    torch.testing.assert_close(normalizer.denormalize(normalizer.normalize(x)), x)
    with pytest.raises(ValueError, match=r"\[0.0\] and \[0.0\]"):
        Normalizer([0.0], [0.0])


def test_another_number_of_entries_is_refused():
    with pytest.raises(ValueError, match=r"\[..., 2\], got \[5, 1\]"):
        Normalizer([0.0, -2.0], [1.0, 4.0]).normalize(torch.zeros(5, 1))
