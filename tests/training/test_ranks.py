"""Training by several processes: the losses of one, a run that resumes with any number, and a process that dies."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from dynmap_rl.runs.folder import read_metrics
from dynmap_rl.utils.ranks import DIED, leave_ranks, mean_over_ranks, rank, ranks

SCRIPT = Path(__file__).with_name("two_ranks.py")
TRAININGS = "world_model", "labelled", "joint", "end_to_end"


def run(folder: Path, processes: int, *arguments: str, launcher: str = "torchrun"):
    """Return the completed command."""
    command = [sys.executable]
    if launcher == "ray":
        arguments += "--compute.launcher", "ray", "--compute.ranks", str(processes)
    else:
        command += ["-m", "torch.distributed.run", "--nproc_per_node", str(processes), "--standalone"]
    tests = os.pathsep.join([str(SCRIPT.parents[1]), *sys.path])
    env = os.environ | {"PYTHONPATH": tests}
    for _ in range(3):  # Ray allows its processes 30 s to start, which a busy machine may exceed
        result = subprocess.run(
            [*command, str(SCRIPT), "--folder", str(folder), *arguments],
            env=env,
            capture_output=True,
            text=True,
            timeout=600,
        )
        if "timed out during startup" not in result.stderr:
            break
    return result


def read_losses(folder: Path) -> dict[str, list[dict]]:
    rows = {name: read_metrics(folder / name) for name in TRAININGS}
    return {name: [{k: v for k, v in row.items() if "loss_" in k} for row in rows[name]] for name in rows}


@pytest.fixture(params=("torchrun", "ray"))
def launcher(request):
    """Return the name of a launcher."""
    if request.param == "ray":
        request.getfixturevalue("ray")
    return request.param


@pytest.fixture(scope="module")
def alone(tmp_path_factory):
    """Return the losses of one process."""
    folder = tmp_path_factory.mktemp("alone")
    assert run(folder, 1).returncode == 0
    return read_losses(folder)


@pytest.mark.slow
def test_two_processes_have_the_losses_of_one(alone, tmp_path, launcher):
    result = run(tmp_path, 2, launcher=launcher)
    assert result.returncode == 0, result.stderr
    assert result.stdout.splitlines() == [f"{SCRIPT}: done"]
    losses = read_losses(tmp_path)
    for name in TRAININGS:
        assert len(losses[name]) == 20
        for a, b in zip(alone[name], losses[name], strict=True):
            assert a == pytest.approx(b, abs=1e-4), name


@pytest.mark.slow
def test_a_process_that_dies_ends_the_run_which_resumes_with_any_number(alone, tmp_path, launcher):
    result = run(tmp_path, 2, "--update", "11", launcher=launcher)
    if launcher == "ray":
        assert result.returncode == 2 and "Traceback" not in result.stderr
        lost = "error: a worker was lost by Ray (WorkerGroupError); the same command resumes"
        assert result.stderr.splitlines()[-1] == lost  # Ray may add a report of its own
    else:
        assert result.returncode and f"error: {DIED}" in result.stderr.splitlines()
    assert len(read_metrics(tmp_path / "world_model")) == 10
    assert run(tmp_path, 1).returncode == 0
    for a, b in zip(alone["world_model"], read_losses(tmp_path)["world_model"], strict=True):
        assert a == pytest.approx(b, abs=1e-4)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("option", "value", "message"),
    [
        ("--windows", "3", "windows of a batch must be a multiple of 2 processes, got 3"),
        (
            "--compute.threads",
            "1000",
            "--compute.ranks must be at most 0, got 2: the Ray cluster has no more room",
        ),
    ],
)
def test_ray_gives_the_same_one_line_for_a_bad_input(ray, tmp_path, option, value, message):
    result = run(tmp_path, 2, option, value, launcher="ray")
    assert result.returncode == 2 and len(result.stderr.splitlines()) == 1
    assert result.stderr.startswith(f"error: {message}")


def test_without_torchrun_there_is_one_rank():
    assert (ranks(), rank(), leave_ranks()) == (1, 0, 0)
    values = object()
    assert mean_over_ranks(values) is values
