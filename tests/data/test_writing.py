"""Files of a recording: columns, splits and statistics."""

import json

import datasets
import numpy as np

from dynmap_rl.data.demonstrations import load_dataset
from dynmap_rl.data.format.writing import make_features
from dynmap_rl.data.recording.record import record_dataset
from dynmap_rl.envs.task import LAYOUT
from dynmap_rl.keys import DYNAMICS


def test_lerobot_reads_the_columns_and_splits(recording):
    info = json.loads((recording / "meta" / "info.json").read_text())
    assert info["splits"] == {"train": "0:4", "eval": "4:6"}
    assert (info["fps"], info["robot_type"], info["total_episodes"]) == (20, "dynmap_cart", 6)
    for name, feature in make_features(LAYOUT).items():
        stored = info["features"][name]
        assert (stored["dtype"], tuple(stored["shape"]), stored["names"]) == tuple(feature.values())


def test_statistics_are_those_of_float64(recording):
    stats = json.loads((recording / "meta" / "stats.json").read_text())
    episodes = load_dataset(recording).double()
    columns = {"action": "action", "observation.state": "agent_pos"}
    columns |= {f"dynamics.{name}": ("dynamics", name) for name in DYNAMICS}
    columns |= {"disturbed": "disturbed", "next.done": ("next", "done")}
    for name, key in columns.items():
        values = episodes[key].flatten(0, 1).numpy()
        np.testing.assert_allclose(stats[name]["mean"], values.mean(0), rtol=1e-10, atol=1e-12)
        np.testing.assert_allclose(stats[name]["std"], values.std(0), rtol=1e-5, atol=1e-7)
        np.testing.assert_allclose(stats[name]["min"], values.min(0))
        np.testing.assert_allclose(stats[name]["max"], values.max(0))
        low, high = np.quantile(values, [0.49, 0.51], axis=0)
        bin_width = (values.max(0) - values.min(0)) / 5000  # of LeRobot's histograms
        rounding = 1e-12
        assert (low - bin_width - rounding <= stats[name]["q50"]).all()
        assert (stats[name]["q50"] <= high + bin_width + rounding).all()
    goals = episodes["goal"][:, 0]
    assert stats["observation.state"]["q01"][3] < goals[:, 0].min() + 1e-3  # not the episodes' mean


def test_statistics_of_the_episodes_are_those_of_float64(recording):
    import pandas

    table = pandas.concat(
        pandas.read_parquet(p) for p in (recording / "meta" / "episodes").rglob("*.parquet")
    )
    goals = load_dataset(recording)["goal"][:, 0].numpy()
    std = np.stack(table["stats/observation.state/std"])
    assert (std[:, 3:] >= 0).all() and (std[:, 3:] < 1e-7).all()  # constant in an episode; float32 gives 1e-4
    np.testing.assert_allclose(np.stack(table["stats/observation.state/mean"])[:, 3:], goals, rtol=1e-9)


def test_images_are_embedded_at_once(tmp_path, monkeypatch):
    """LeRobot embeds them row by row, both of an episode and of a merged file, which takes longer than the simulation."""

    def refuse(*_, **__):
        raise AssertionError("row by row")

    monkeypatch.setattr(datasets.Dataset, "map", refuse)
    record_dataset(tmp_path / "recording", episodes=1, eval_episodes=1, workers=1)
    assert len(load_dataset(tmp_path / "recording")) == 2
