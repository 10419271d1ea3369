"""World models and policies as folders: ``weights.safetensors`` and ``arguments.json``, complete by themselves."""

from __future__ import annotations

from pathlib import Path

import torch

from dynmap_rl.keys import DYNAMICS
from dynmap_rl.utils.files import read_json, write_json
from dynmap_rl.utils.weights import load_module, save_weights

from .normalization import Normalizer
from .policy import FeedforwardPolicy, RecurrentPolicy
from .world_model import WorldModel

MOST_CAMERAS = 16  # of a file from elsewhere: each has an encoder and a decoder of its own
POLICIES = {policy.kind: policy for policy in (FeedforwardPolicy, RecurrentPolicy)}


def make_world_model(
    constants: dict,
    supervision: tuple[str, ...],
    latent_size: int = 64,
    hidden_size: int = 128,
    architecture: str = "glimpse",
    image_size: int = 64,
    cameras: int = 1,
) -> WorldModel:
    """Make a world model with random weights.

    :func:`dynmap_rl.training.build_world_model` makes one by typed settings, with torchvision's weights where they ask for
    them.

    Args:
        constants: of the dataset's normalisation, ``{name: {"low": [D], "high": [D]}}``.
        supervision: quantities that are decoded.
        latent_size: Z.
        hidden_size: H.
        architecture: see :class:`dynmap_rl.modules.WorldModel`, as for the following arguments.
        image_size: side of the frames of a camera.
        cameras: number of cameras.

    Raises:
        ValueError: a quantity has no constants.
    """
    if isinstance(supervision, str) or not set(supervision) <= set(DYNAMICS):
        raise ValueError(f"supervision must be a sequence of {', '.join(DYNAMICS)}, got {supervision!r}")
    if missing := [name for name in ("action", *supervision) if name not in constants]:
        raise ValueError(f"constants must have {', '.join(missing)}, got {', '.join(constants) or 'none'}")
    dynamics = {q: Normalizer(**constants[q]) for q in supervision}
    sizes = latent_size, hidden_size, architecture, image_size, cameras
    return WorldModel(Normalizer(**constants["action"]), dynamics, *sizes)


def make_policy(
    constants: dict, kind: str, world_model: WorldModel, **arguments
) -> FeedforwardPolicy | RecurrentPolicy:
    """Make a policy with random weights.

    Args:
        constants: of the dataset's normalisation, ``{name: {"low": [D], "high": [D]}}``.
        kind: ``feedforward`` or ``recurrent``.
        world_model: world model whose states the policy reads.
        **arguments: arguments of the policy, such as ``width``.

    Raises:
        ValueError: the kind is unknown.
    """
    check_policy(kind)
    sizes = world_model.latent_size, world_model.hidden_size
    action, goal = Normalizer(**constants["action"]), Normalizer(**constants["goal"])
    return POLICIES[kind](*sizes, action, goal, **arguments)


def check_policy(kind: str) -> None:
    """Raise ``ValueError`` for an unknown kind."""
    if str(kind) not in POLICIES:
        raise ValueError(f"the kind of a policy must be one of {', '.join(sorted(POLICIES))}, got {kind!r}")


def save_world_model(folder: str | Path, model: WorldModel) -> None:
    """Write weights and sizes of a world model to a folder.

    Raises:
        TypeError: the world model is of a class that :func:`load_world_model` does not know.
    """
    if type(model) is not WorldModel:
        raise TypeError(
            f"model must be a WorldModel, got {type(model).__name__}; store a class of your own with "
            "torch.save(model.state_dict(), path)"
        )
    arguments = {
        "action": model.transition.action.size,
        "dynamics": model.sizes,
        "latent_size": model.latent_size,
        "hidden_size": model.hidden_size,
        "architecture": model.architecture,
        "image_size": model.image_size,
        "cameras": model.cameras,
    }
    # Weights first: arguments alone would be a damaged checkpoint.
    save_weights(Path(folder) / "weights.safetensors", model)
    write_json(Path(folder) / "arguments.json", arguments)


def load_world_model(folder: str | Path) -> WorldModel:
    """Load a world model, in evaluation mode.

    Raises:
        ValueError: the folder holds no world model, or a damaged one.
    """
    arguments = _read_arguments(folder)
    if "dynamics" not in arguments:
        raise ValueError(f"{folder} holds a policy, not a world model")
    if arguments.pop("keypoints", False):  # of the first release, as is a folder without architecture
        raise ValueError(
            f"{folder} has the keypoints of the first release, which this one lacks; train it again"
        )
    arguments.setdefault("architecture", "plain")
    if (cameras := arguments.get("cameras", 1)) not in range(1, MOST_CAMERAS + 1):
        raise ValueError(f"{folder}/arguments.json must have 1 to {MOST_CAMERAS} cameras, got {cameras}")

    def make() -> WorldModel:
        dynamics = {q: _blank(size) for q, size in arguments["dynamics"].items()}
        return WorldModel(**{**arguments, "action": _blank(arguments["action"]), "dynamics": dynamics})

    return load_module(Path(folder) / "weights.safetensors", make).eval()


def save_policy(
    folder: str | Path, policy: FeedforwardPolicy | RecurrentPolicy, world_model: WorldModel
) -> None:
    """Write weights, kind and sizes of a policy to a folder.

    Args:
        folder: gets ``weights.safetensors`` and ``arguments.json``.
        policy: policy to save.
        world_model: world model whose states the policy reads.

    Raises:
        TypeError: the policy is of a class that :func:`load_policy` does not know.
    """
    if type(policy) not in POLICIES.values():
        raise TypeError(
            f"policy must be a FeedforwardPolicy or a RecurrentPolicy, got {type(policy).__name__}; store a class of your "
            "own with torch.save(policy.state_dict(), path)"
        )
    arguments = {
        "kind": policy.kind,
        "latent_size": world_model.latent_size,
        "hidden_size": world_model.hidden_size,
        "action": policy.action.size,
        "goal": policy.goal.size,
        "width": policy.width,
    }
    save_weights(Path(folder) / "weights.safetensors", policy)
    write_json(Path(folder) / "arguments.json", arguments)


def load_policy(folder: str | Path) -> FeedforwardPolicy | RecurrentPolicy:
    """Load a policy, in evaluation mode.

    Raises:
        ValueError: the folder holds no policy, or a damaged one.
    """
    arguments = _read_arguments(folder)
    if "kind" not in arguments:
        raise ValueError(f"{folder} holds a world model, not a policy")
    check_policy(kind := arguments.pop("kind"))

    def make() -> FeedforwardPolicy | RecurrentPolicy:
        normalizers = {name: _blank(arguments[name]) for name in ("action", "goal")}
        return POLICIES[kind](**{**arguments, **normalizers})

    return load_module(Path(folder) / "weights.safetensors", make).eval()


def _read_arguments(folder: str | Path) -> dict:
    path = Path(folder) / "arguments.json"
    if not path.exists():
        raise ValueError(f"no checkpoint in {folder} (no arguments.json); check the path, or train one")
    return read_json(path)


def _blank(size: int) -> Normalizer:
    """Make a normaliser whose constants the weights overwrite."""
    return Normalizer(-torch.ones(size), torch.ones(size))
