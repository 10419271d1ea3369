"""The collect recipe: recordings and their pages. tests/data/test_hub.py tests uploads."""

import pytest
from commands import run

from dynmap_rl.data.demonstrations import load_dataset


@pytest.mark.parametrize(
    ("arguments", "name"),
    [
        ([], "balance_reaching"),
        pytest.param(["--kind", "undisturbed"], "balance_reaching_undisturbed", marks=pytest.mark.slow),
        pytest.param(
            ["--kind", "exploration", "--task", "bin_dropping"],
            "bin_dropping_exploration",
            marks=pytest.mark.slow,
        ),
    ],
)
def test_a_recording_is_written_once_with_a_page(tmp_path, arguments, name):
    arguments = "--episodes", "1", "--eval_episodes", "1", "--workers", "1", *arguments
    result = run(tmp_path, "collect", *arguments)
    assert result.returncode == 0 and f"datasets/{name}" in result.stdout
    page = (tmp_path / f"runs/collect/{name}/report.html").read_text()
    assert "240 frames" in page and page.count("data:image/") == 2
    root = tmp_path / "datasets" / name
    assert load_dataset(root).shape == (2, 120)
    assert {path.name for path in root.parent.iterdir()} <= {name, f"{name}.cache"}
    before = {path: path.stat().st_mtime_ns for path in root.rglob("*.parquet")}
    assert "already complete" in run(tmp_path, "collect", *arguments).stdout
    assert before == {path: path.stat().st_mtime_ns for path in root.rglob("*.parquet")}


def test_another_recording_is_refused(recording, tmp_path):
    result = run(tmp_path, "collect", "--output", recording)
    assert result.returncode == 2 and result.stderr.count("\n") == 1
    assert "another recording (episodes 4 instead of 300" in result.stderr


def test_what_cannot_be_uploaded_is_not_recorded(tmp_path):
    pytest.importorskip("metaworld")
    result = run(tmp_path, "collect", "--task", "mujoco:PlateSlide", "--push_to_hub", "me/plates")
    assert result.returncode == 2 and "--push_to_hub" in result.stderr
    assert not any(tmp_path.iterdir())


def test_without_the_hub_nothing_is_recorded_for_it(tmp_path, monkeypatch):
    result = run(tmp_path, "collect", "--push_to_hub", "me/mine")
    assert result.returncode == 2 and "HF_HUB_OFFLINE" in result.stderr
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_OFFLINE", False)
    monkeypatch.setattr("huggingface_hub.get_token", lambda: None)
    result = run(tmp_path, "collect", "--push_to_hub", "me/mine")
    assert result.returncode == 2 and "hf auth login" in result.stderr
    assert not any(tmp_path.iterdir())
