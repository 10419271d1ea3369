"""Settings of the augmentation."""

import pytest

from dynmap_rl.data.settings import Augmentation


def test_values_are_checked():
    assert not any(vars(Augmentation.off()).values())
    for name in ("max_shift", "distractors"):
        with pytest.raises(ValueError, match=name):
            Augmentation(**{name: -1})
