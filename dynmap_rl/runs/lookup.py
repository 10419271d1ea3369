"""Runs by name, folder or id: their world models, actors and tasks."""

from __future__ import annotations

from pathlib import Path

from dynmap_rl.envs.protocol import BaseTask
from dynmap_rl.modules.actor import Actor
from dynmap_rl.modules.checkpoints import load_policy, load_world_model
from dynmap_rl.modules.world_model import WorldModel
from dynmap_rl.utils.files import read_json
from dynmap_rl.utils.hub import first_line, is_hub_id

SHIPPED = Path(__file__).parents[1] / "pretrained"
TRAININGS = ("decoupled", "joint", "end_to_end")


def find_run(run: str | Path) -> Path:
    """Return the folder of a run.

    Args:
        run: name of a run that ships with the package, a folder, or an id on the Hugging Face hub (``user/name``), of
            which settings, world models and policies are downloaded.

    Raises:
        ValueError: the hub has no such run or cannot be reached.
    """
    shipped, folder = SHIPPED / run, Path(run).expanduser()
    if (shipped / "config.json").exists():
        return shipped
    if folder.exists() or not is_hub_id(run, "runs"):
        return folder
    from httpx import HTTPError
    from huggingface_hub import snapshot_download

    parts = ["config.json", "eval.json", "world_model/*", "seed_*/world_model/*", "seed_*/policy/*"]
    try:
        return Path(snapshot_download(run, allow_patterns=parts))
    except (OSError, ValueError, HTTPError) as error:  # the hub's client, or the network below it
        reason = first_line(error)
        raise ValueError(f"no run at {run}, neither as a folder nor on the hub ({reason})") from error


def has_world_model(folder: Path) -> bool:
    """Return whether a folder is a run, and not a LeRobot policy."""
    return (folder / "world_model").exists() or any(folder.glob("seed_*/policy"))


def load_actor(run: str | Path, seed: int = 0) -> Actor:
    """Load world model and policy of a run, in evaluation mode and in the precision of the recipes' evaluation.

    Args:
        run: see :func:`find_run`; ``"balance_reaching"`` ships with the package.
        seed: seed of the policy.

    Raises:
        ValueError: the run has no policy of that seed.
    """
    run = find_run(run)
    seeds = sorted(folder.parent.name for folder in run.glob("seed_*/policy"))
    if seeds and f"seed_{seed}" not in seeds:
        raise ValueError(
            f"{run} must have a policy in seed_{seed}, got {', '.join(seeds)}; choose one of these"
        )
    own = run / f"seed_{seed}" / "world_model"  # joint training has a world model for each seed
    world_model = load_world_model(own if own.exists() else run / "world_model")
    return Actor(world_model, load_policy(run / f"seed_{seed}" / "policy"), mixed=True)


def check_actions(world_model: WorldModel, origin: dict[str, str], task: BaseTask, run: str | Path) -> None:
    """Check that a world model can be used on a task.

    Args:
        world_model: world model of a run.
        origin: its origin (see :func:`load_world_model_of`).
        task: the task.
        run: the run, for the message.

    Raises:
        ValueError: it is of a robot dataset, or of a task with other actions.
    """
    if "task" not in origin or world_model.transition.action.size != len(task.layout.action_limit):
        raise ValueError(f"--pretrained must be of a task with the actions of {task.name}, got {run}")


def load_world_model_of(run: str | Path) -> tuple[WorldModel, dict[str, str]]:
    """Load the world model of a finished run, with its origin.

    Args:
        run: see :func:`find_run`; the folder ``world_model`` of a run is accepted too, and so is the folder ``seed_N`` of
            a run of joint or end-to-end training.

    Returns:
        The world model, and a dict with ``training`` (decoupled, joint or end_to_end) and ``task``, or ``dataset`` for
        a robot dataset.

    Raises:
        ValueError: the folder holds no finished run.
    """
    run = find_run(str(run))
    run = run.parent if run.name == "world_model" else run
    of_seed = run.name.startswith("seed_") and not (run / "config.json").exists()
    top = run.parent if of_seed and (run / "world_model").exists() else run
    source = read_json(top / "eval.json").get("world_model") if (top / "eval.json").exists() else None
    # The file may be from elsewhere, and folders are named after the training.
    known = isinstance(source, dict) and source.get("training") in TRAININGS
    if not known or not isinstance(source.get("task", source.get("dataset")), str):
        raise ValueError(f"{run} holds no finished run; train a world model with recipes/decoupled.py first")
    return load_world_model(run / "world_model"), source


def task_of_run(run: Path) -> str | None:
    """Return the task that a run was trained on; None where the run does not name one.

    Raises:
        ValueError: the run was trained on a robot dataset, for which there is no simulator, or ``config.json`` is
            damaged.
    """
    settings = read_json(run / "config.json") if (run / "config.json").exists() else {}
    if not isinstance(task := settings.get("task"), str | None):
        raise ValueError(f"{run / 'config.json'}: task must be a name, got {task}; restore the file")
    if task is None and settings.get("dataset"):
        raise ValueError(
            f"{run} was trained on the robot dataset {settings['dataset']}, which has no simulator and no policy type of "
            "LeRobot; its held-out errors are in eval.json, RobotActor and export_to_onnx bring it to a robot"
        )
    return task
