"""The probe recipe on untrained world models."""

import pytest
from commands import run

from dynmap_rl.data.demonstrations import load_meta
from dynmap_rl.modules.checkpoints import make_world_model, save_world_model
from dynmap_rl.utils.files import read_json, write_json


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
    assert list(facts["probes"]) == list(facts["verdicts"]) == ["Only-RGB, decoupled", "RGB+[P], decoupled"]
    assert len(facts["probes"]["Only-RGB, decoupled"]["latent"]["velocity"]) == 6
    for found in facts["perception"].values():
        assert list(found) == ["held-out demonstrations", "first ten steps"]
        for values in found.values():
            assert (
                values["chroma_explained"] < 0.5
                and values["object_error"] > 0.05
                and values["cart_error"] > 0
            )
    for name in ("open_loop", "probes", "perception"):
        assert (tmp_path / f"runs/probe/{name}.png").stat().st_size > 10_000
    page = (tmp_path / "runs/probe/report.html").read_text()
    assert page.count("data:image/png") == 3 and all(line in page for line in result.stdout.splitlines()[:-1])


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--runs", "nothing"], "nothing"),
        (["--runs", "none,none"], "Only-RGB, decoupled twice"),
        (["--runs", "none", "--test_episodes", "0"], "test_episodes"),
        (["--runs", "position", "--horizon", "200"], "120, got 20 + 200"),
    ],
)
def test_bad_input_is_refused_before_anything_is_written(trained, recording, arguments, message):
    before = sorted(trained.rglob("*"))
    result = run(trained, "probe", "--dataset", recording, *arguments)
    assert result.returncode == 2
    assert message in result.stderr and result.stderr.count("\n") == 1
    assert sorted(trained.rglob("*")) == before
