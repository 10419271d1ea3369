"""Training by several processes: the losses of one, a run that resumes with any number, and a process that dies."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from dynmap_rl.runs.folder import read_metrics
from dynmap_rl.utils.ranks import DIED, leave_ranks, mean_over_ranks, rank, ranks

SCRIPT = Path(__file__).with_name("two_ranks.py")
TRAININGS = "world_model", "joint", "end_to_end"


def run(folder: Path, processes: int, *arguments: str) -> subprocess.CompletedProcess:
    torchrun = [
        sys.executable,
        "-m",
        "torch.distributed.run",
        "--nproc_per_node",
        str(processes),
        "--standalone",
    ]
    tests = os.pathsep.join([str(SCRIPT.parents[1]), *sys.path])
    return subprocess.run(
        [*torchrun, str(SCRIPT), str(folder), *arguments],
        env=os.environ | {"PYTHONPATH": tests},
        capture_output=True,
        text=True,
        timeout=600,
    )


def read_losses(folder: Path) -> dict[str, list[dict]]:
    rows = {name: read_metrics(folder / name) for name in TRAININGS}
    return {name: [{k: v for k, v in row.items() if "loss_" in k} for row in rows[name]] for name in rows}


@pytest.fixture(scope="module")
def alone(tmp_path_factory):
    """Return the losses of one process."""
    folder = tmp_path_factory.mktemp("alone")
    assert run(folder, 1).returncode == 0
    return read_losses(folder)


@pytest.mark.slow
def test_two_processes_have_the_losses_of_one(alone, tmp_path):
    result = run(tmp_path, 2)
    assert result.returncode == 0, result.stderr
    losses = read_losses(tmp_path)
    for name in TRAININGS:
        assert len(losses[name]) == 20
        for a, b in zip(alone[name], losses[name], strict=True):
            assert a == pytest.approx(b, abs=1e-4), name


@pytest.mark.slow
def test_a_process_that_dies_ends_the_run_which_resumes_with_any_number(alone, tmp_path):
    result = run(tmp_path, 2, "11")
    assert result.returncode and f"error: {DIED}" in result.stderr.splitlines()
    assert len(read_metrics(tmp_path / "world_model")) == 10
    assert run(tmp_path, 1).returncode == 0
    for a, b in zip(alone["world_model"], read_losses(tmp_path)["world_model"], strict=True):
        assert a == pytest.approx(b, abs=1e-4)


def test_without_torchrun_there_is_one_rank():
    assert (ranks(), rank(), leave_ranks()) == (1, 0, 0)
    values = object()
    assert mean_over_ranks(values) is values
