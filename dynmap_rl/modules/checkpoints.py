"""World models and policies as folders: ``weights.safetensors`` and ``arguments.json``, complete by themselves."""

from __future__ import annotations

from pathlib import Path

import torch

from dynmap_rl.envs.tasks import NO_TASK
from dynmap_rl.hub import first_line, is_hub_id
from dynmap_rl.runs import read_json, write_json
from dynmap_rl.weights import load_module, save_weights

from .normalization import Normalizer
from .policy import FeedforwardPolicy, RecurrentPolicy
from .tensordict_modules import Actor
from .world_model import WorldModel

SHIPPED = Path(__file__).parents[1] / "pretrained"
POLICIES = {"feedforward": FeedforwardPolicy, "recurrent": RecurrentPolicy}


def make_world_model(
    constants: dict, supervision: tuple[str, ...], latent_size=64, hidden_size=128, keypoints=False
) -> WorldModel:
    """A fresh world model with a dataset's normalisation constants (``{name: {"low": [D], "high": [D]}}``)."""
    dynamics = {q: Normalizer(**constants[q]) for q in supervision}
    return WorldModel(Normalizer(**constants["action"]), dynamics, latent_size, hidden_size, keypoints)


def make_policy(
    constants: dict, kind: str, world_model: WorldModel, **arguments
) -> FeedforwardPolicy | RecurrentPolicy:
    """A fresh policy of a kind, ``feedforward`` or ``recurrent``; ``arguments`` are its own (``width``, ...)."""
    check_policy(kind)
    sizes = world_model.latent_size, world_model.hidden_size
    action, goal = Normalizer(**constants["action"]), Normalizer(**constants["goal"])
    return POLICIES[kind](*sizes, action, goal, **arguments)


def check_policy(kind: str) -> None:
    """Raises ``ValueError`` for an unknown kind."""
    if str(kind) not in POLICIES:
        raise ValueError(f"unknown policy {kind!r}; choose from {sorted(POLICIES)}")


def save_world_model(folder: Path, model: WorldModel) -> None:
    """Write its weights, and its sizes as ``arguments.json``."""
    arguments = {
        "action": model.transition.action.size,
        "dynamics": {q: n.size for q, n in model.dynamics_decoder.normalizers.items()},
        "latent_size": model.latent_size,
        "hidden_size": model.hidden_size,
        "keypoints": model.keypoints,
    }
    write_json(Path(folder) / "arguments.json", arguments)
    save_weights(Path(folder) / "weights.safetensors", model)


def load_world_model(folder: Path) -> WorldModel:
    """Raises ``ValueError`` where the folder holds no world model."""
    arguments = _read_arguments(folder)
    if "dynamics" not in arguments:
        raise ValueError(f"{folder} holds a policy, not a world model")

    def make() -> WorldModel:
        dynamics = {q: _blank(size) for q, size in arguments["dynamics"].items()}
        return WorldModel(**{**arguments, "action": _blank(arguments["action"]), "dynamics": dynamics})

    return load_module(Path(folder) / "weights.safetensors", make).eval()


def save_policy(folder: Path, policy: FeedforwardPolicy | RecurrentPolicy, world_model: WorldModel) -> None:
    """Write its weights, and its kind and sizes as ``arguments.json``; the world model is the one that it acts on."""
    recurrent = isinstance(policy, RecurrentPolicy)
    arguments = {
        "kind": "recurrent" if recurrent else "feedforward",
        "latent_size": world_model.latent_size,
        "hidden_size": world_model.hidden_size,
        "action": policy.action.size,
        "goal": policy.goal.size,
        "width": policy.width,
    }
    write_json(Path(folder) / "arguments.json", arguments)
    save_weights(Path(folder) / "weights.safetensors", policy)


def load_policy(folder: Path) -> FeedforwardPolicy | RecurrentPolicy:
    """Raises ``ValueError`` where the folder holds no policy."""
    arguments = _read_arguments(folder)
    if "kind" not in arguments:
        raise ValueError(f"{folder} holds a world model, not a policy")
    check_policy(kind := arguments.pop("kind"))

    def make() -> FeedforwardPolicy | RecurrentPolicy:
        normalizers = {name: _blank(arguments[name]) for name in ("action", "goal")}
        return POLICIES[kind](**{**arguments, **normalizers})

    return load_module(Path(folder) / "weights.safetensors", make).eval()


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


def _read_arguments(folder: Path) -> dict:
    path = Path(folder) / "arguments.json"
    if not path.exists():
        raise ValueError(f"{folder} holds no checkpoint (no arguments.json); train one first")
    return read_json(path)


def _blank(size: int) -> Normalizer:
    """A normaliser whose constants the weights will overwrite."""
    return Normalizer(-torch.ones(size), torch.ones(size))
