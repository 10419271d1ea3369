"""Conversion of run folders to LeRobot's ``pretrained_model`` folders, and back."""

from __future__ import annotations

import shutil
from pathlib import Path

from draccus.utils import DraccusException
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.utils.constants import ACTION, OBS_STATE
from safetensors import SafetensorError

from dynmap_rl.keys import CAMERA, FRAME_SHAPE
from dynmap_rl.modules.checkpoints import load_world_model, save_policy, save_world_model
from dynmap_rl.runs.lookup import find_run, load_actor, task_of_run
from dynmap_rl.utils.files import read_json, write_json
from dynmap_rl.utils.hub import first_line
from dynmap_rl.utils.weights import fingerprint

from .configuration_dynmap import DynmapConfig
from .modeling_dynmap import DynmapPolicy
from .processor_dynmap import make_dynmap_pre_post_processors


def export_to_lerobot(run: str | Path, folder: str | Path, seed: int = 0) -> Path:
    """Write world model and policy of a run for ``--policy.path`` of LeRobot's commands.

    Args:
        run: a run (see :func:`dynmap_rl.runs.find_run`).
        folder: gets ``config.json``, with the task and the origin of the world model, ``model.safetensors`` and the
            processors.
        seed: seed of the policy.

    Returns:
        The folder.

    Raises:
        ValueError: the run has no policy of that seed, or was trained on a robot dataset.
    """
    folder, run = Path(folder).expanduser(), find_run(run)
    task, actor = task_of_run(run), load_actor(run, seed)
    world_model, policy = actor.world_model, actor.policy
    sizes = {"action": policy.action.size, "goal": policy.goal.size}
    sizes |= {"image_size": world_model.image_size, "cameras": world_model.cameras}
    expected = DynmapConfig().sizes | {"image_size": FRAME_SHAPE[0], "cameras": 1}
    if other := {name: size for name, size in sizes.items() if size != expected[name]}:
        raise ValueError(f"{run} must be a run of a task of cart and block, got other sizes: {other}")
    results = read_json(run / "eval.json") if (run / "eval.json").exists() else {}
    config = DynmapConfig(
        task=task,
        source=results.get("world_model"),
        supervision=",".join(world_model.supervision) or "none",
        kind=policy.kind,
        latent_size=world_model.latent_size,
        hidden_size=world_model.hidden_size,
        architecture=world_model.architecture,
        width=policy.width,
        sizes=DynmapConfig().sizes | world_model.sizes,
        input_features={
            CAMERA: PolicyFeature(FeatureType.VISUAL, (FRAME_SHAPE[2], *FRAME_SHAPE[:2])),
            OBS_STATE: PolicyFeature(FeatureType.STATE, (5,)),
        },
        output_features={ACTION: PolicyFeature(FeatureType.ACTION, (3,))},
    )
    exported = DynmapPolicy(config)
    exported.world_model.load_state_dict(world_model.state_dict())
    exported.policy.load_state_dict(policy.state_dict())
    exported.save_pretrained(folder)
    for processor in make_dynmap_pre_post_processors(config):
        processor.save_pretrained(folder)
    return folder


def import_from_lerobot(folder: str | Path, run: str | Path, seed: int = 0) -> Path:
    """Write world model and policy of a ``pretrained_model`` folder as a run folder.

    ``config.json`` gets the task, and ``eval.json`` the origin of the world model, where the folder names them. The run
    has no results.

    Args:
        folder: written by :func:`export_to_lerobot` or by ``lerobot-train --policy.type=dynmap``.
        run: run folder; gets ``world_model`` and ``seed_N/policy``. Where a policy of another seed needs the world model
            that is there, of another training with LeRobot, the policy's own is ``seed_N/world_model``.
        seed: seed under which the policy is stored, in the place of one that is there.

    Returns:
        The run folder.

    Raises:
        ValueError: the folder holds no policy ``dynmap``, or ``run`` holds another run.
    """
    folder, run = Path(folder).expanduser(), Path(run).expanduser()
    if not (folder / "config.json").exists():
        raise ValueError(f"{folder} holds no LeRobot policy (no config.json)")
    try:
        config = DynmapConfig.from_pretrained(folder)
    except DraccusException as error:
        raise ValueError(f"{folder} holds no policy dynmap ({first_line(error)})") from error
    if not isinstance(config, DynmapConfig):
        raise ValueError(f"{folder} must hold a policy of the type dynmap, got {config.type}")
    source = config.source or {}
    settings = {"task": config.task}
    if (run / "config.json").exists() and read_json(run / "config.json") != settings:
        raise ValueError(f"{run} holds another run; choose another folder")
    try:
        policy = DynmapPolicy.from_pretrained(folder, config=config)
    except (OSError, SafetensorError) as error:
        raise ValueError(f"{folder} holds no weights that can be read ({first_line(error)})") from error
    write_json(run / "config.json", settings)
    seed_folder, first = run / f"seed_{seed}", run / "world_model"
    others = [policy.parent for policy in run.glob("seed_*/policy") if policy.parent != seed_folder]
    needed = first.exists() and any(not (other / "world_model").exists() for other in others)
    shared = not needed or fingerprint(load_world_model(first)) == fingerprint(policy.world_model)
    shutil.rmtree(seed_folder, ignore_errors=True)  # a policy must never lie beside another world model
    save_world_model(first if shared else seed_folder / "world_model", policy.world_model)
    save_policy(seed_folder / "policy", policy.policy, policy.world_model)
    if shared and source:
        write_json(run / "eval.json", {"world_model": source, "imported_from": str(folder)})
    elif not needed:  # what is there is of the world model that was there
        (run / "eval.json").unlink(missing_ok=True)
    return run
