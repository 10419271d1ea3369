"""The figures recipe, on a small dataset."""

import pytest

from dynmap_rl.runs import read_json
from recipes.figures import Config, main


def test_draws_the_distributions_and_writes_their_ranges(recording, tmp_path):
    main(Config(datasets=str(recording), output=tmp_path / "figures"))
    assert (tmp_path / "figures/distributions.png").stat().st_size > 5000
    ranges = read_json(tmp_path / "figures/distributions.json")["ranges"]["balance_reaching"]
    assert set(ranges) == {"cart angle", "block angle", "cart angular velocity", "block angular velocity"}
    for low, middle, high in ranges.values():
        assert 0 <= low <= middle < high
    assert ranges["block angle"][2] < 1, "demonstrations of task 1 carry the block upright"


def test_a_missing_dataset_is_named(tmp_path):
    with pytest.raises(ValueError, match="no dataset at datasets/nothing"):
        main(Config(datasets="datasets/nothing", output=tmp_path / "figures"))
    assert not (tmp_path / "figures").exists()
