"""Settings of the augmentation."""

import pytest

from dynmap_rl.data.settings import Augmentation


def test_values_are_checked():
    assert not any(vars(Augmentation.off()).values())
    with pytest.raises(ValueError, match="max_shift"):
        Augmentation(max_shift=-1)
