"""The probe recipe on untrained world models, and what its numbers mean."""

import pytest
import torch
from commands import run

from dynmap_rl.data.demonstrations import load_dataset
from dynmap_rl.data.demonstrations import load_meta
from dynmap_rl.evaluation import probing  # MODULE
from dynmap_rl.modules.checkpoints import make_world_model
from dynmap_rl.modules.checkpoints import save_world_model
from dynmap_rl.utils.files import read_json
from dynmap_rl.utils.files import write_json


@pytest.fixture(scope="module")
def trained(recording, tmp_path_factory):
    folder, constants = tmp_path_factory.mktemp("runs"), load_meta(recording)["normalization"]
    for name, supervision in (("none", ()), ("position", ("position",))):
        save_world_model(folder / name / "world_model", make_world_model(constants, supervision))
        source = {"task": "balance_reaching", "training": "decoupled"}
        write_json(folder / name / "eval.json", {"world_model": source})
    return folder


def test_writes_errors_and_probes_of_every_world_model(trained, recording, tmp_path):
    arguments = "--dataset", recording, "--context", "3", "--horizon", "4", "--train_episodes", "3"
    result = run(tmp_path, "probe", "--runs", f"{trained / 'none'}, {trained / 'position'}", *arguments)
    assert result.returncode == 0, result.stderr
    facts = read_json(tmp_path / "runs/probe/probe.json")
    assert (facts["train_episodes"], facts["test_episodes"]) == (3, 2)
    assert list(facts["open_loop"]) == ["RGB+[P], decoupled"]
    assert len(facts["open_loop"]["RGB+[P], decoupled"]["model"]["cart_mm"]) == 4
    assert list(facts["probes"]) == ["Only-RGB, decoupled", "RGB+[P], decoupled"]
    assert len(facts["probes"]["Only-RGB, decoupled"]["latent"]["velocity"]) == 6
    assert "RGB+[P], decoupled: after 0.2 s without frames the cart is" in result.stdout
    for name in ("open_loop", "probes"):
        assert (tmp_path / f"runs/probe/{name}.png").stat().st_size > 10_000
    page = (tmp_path / "runs/probe/report.html").read_text()
    assert page.count("data:image/png") == 2 and "after 0.2 s without frames the cart is" in page


def test_a_linear_map_tells_what_is_linear_and_nothing_of_what_is_independent(recording, monkeypatch):
    train, test = load_dataset(recording, "train"), load_dataset(recording, "eval")
    mix = torch.randn(6, 40, generator=torch.Generator().manual_seed(0))

    def features(_, episodes):
        position = episodes["dynamics", "position"]
        noise = torch.randn(*position.shape[:-1], 40, generator=torch.Generator().manual_seed(len(episodes)))
        return {"latent": 5 * position @ mix + 3, "hidden1": noise, "hidden2": torch.zeros_like(noise)}

    monkeypatch.setattr(probing, "compute_features", features)
    r2 = probing.probe(None, train, test)
    assert min(r2["latent"]["position"]) > 0.999
    assert max(r2["hidden1"]["velocity"]) < 0.1
    assert max(r2["hidden2"]["velocity"]) < 1e-9, "a constant is no better than the mean"


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--runs", "nothing"], "nothing holds no finished run"),
        (["--runs", "none,none"], "has Only-RGB, decoupled twice"),
        (["--runs", "none", "--test_episodes", "0"], "must be at least 1"),
        (["--runs", "position", "--horizon", "200"], "do not fit into episodes of 120"),
    ],
)
def test_bad_input_is_refused_before_anything_is_written(trained, recording, arguments, message):
    before = sorted(trained.rglob("*"))
    result = run(trained, "probe", "--dataset", recording, *arguments)
    assert result.returncode == 2
    assert message in result.stderr and result.stderr.count("\n") == 1
    assert sorted(trained.rglob("*")) == before
