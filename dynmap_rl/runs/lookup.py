"""Policies on a frozen world model, what decoupled training and generalisation share (paper, Sec. III-B and V-D).

The world model's states are computed once; every policy seed is then trained, and judged, in a process of its own,
and the weights of the world model are shown to be the same before and after.
"""

from __future__ import annotations

from pathlib import Path

from dynmap_rl.envs.tasks import NO_TASK
from dynmap_rl.modules.actor import Actor
from dynmap_rl.modules.checkpoints import load_policy, load_world_model
from dynmap_rl.modules.world_model import WorldModel
from dynmap_rl.utils.files import read_json
from dynmap_rl.utils.hub import first_line, is_hub_id

TRAININGS = ["decoupled", "joint", "end_to_end"]


def load_source(run: str | Path) -> tuple[WorldModel, dict[str, str]]:
    """The world model of a finished run, and where it is from: ``task`` and ``training`` (decoupled or joint).

    Args:
        run: its folder, or the ``world_model`` in it; its id on the hub; or the name of a run that ships with the
            package (see :func:`dynmap_rl.modules.find_run`).

    Raises:
        ValueError: the folder is no such run, or it is not done.
    """
    run = find_run(str(run))
    run = run.parent if run.name == "world_model" else run
    source = read_json(run / "eval.json").get("world_model") if (run / "eval.json").exists() else None
    # The file may be a stranger's, and a folder is named after the training.
    known = isinstance(source, dict) and source.get("training") in TRAININGS
    if not known or not isinstance(source.get("task"), str):
        raise ValueError(f"{run} holds no finished run; train a world model with recipes/decoupled.py first")
    return load_world_model(run / "world_model"), source


SHIPPED = Path(__file__).parents[1] / "pretrained"


def load_actor(run: str | Path, seed: int = 0) -> Actor:
    """World model and policy of a run as they act in its evaluation.

    Args:
        run: a run folder of ``recipes/decoupled.py``, ``joint.py``, ``end_to_end.py`` or ``generalize.py``, its id on
            the Hugging Face hub, or ``"balance_reaching"``: a run of task 1 ships with the package.
        seed: of the policy.

    Raises:
        ValueError: the folder holds no policy of that seed.
    """
    run = find_run(run)
    own = run / f"seed_{seed}" / "world_model"  # joint training has one for each seed
    world_model = load_world_model(own if own.exists() else run / "world_model")
    return Actor(world_model, load_policy(run / f"seed_{seed}" / "policy"), mixed=True)


def find_run(run: str | Path) -> Path:
    """The folder of a run: one that ships with the package, by its name, or one on the Hugging Face hub, by its id
    (``user/name``), of which the settings, world models and policies are downloaded, or else the path itself.

    Raises:
        ValueError: there is neither such a folder nor such a run on the hub.
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
    except (OSError, ValueError, HTTPError) as error:  # of the hub's client, or of the network below it
        reason = first_line(error)
        raise ValueError(f"no policy at {run}, neither as a folder nor on the hub ({reason})") from error


def task_of_run(run: Path) -> str | None:
    """The task that a run folder was trained on; None where it does not say.

    Raises:
        ValueError: it was trained on a dataset of no task of ours, and there is no simulator for it.
    """
    settings = read_json(run / "config.json") if (run / "config.json").exists() else {}
    if not isinstance(task := settings.get("task"), str | None):
        raise ValueError(f"{run / 'config.json'} names no task, but {task}; restore it")
    if task == NO_TASK:
        raise ValueError(
            f"{run} was trained on {settings.get('dataset')}, for which there is no simulator; its eval.json has its "
            "errors on held-out episodes"
        )
    return task
