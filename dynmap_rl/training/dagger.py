"""Corrections of a policy by the expert: DAgger (Ross et al. 2011)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModuleBase
from torch import nn
from torchrl.envs.utils import step_mdp
from tqdm import tqdm

from dynmap_rl.data.features import compute_features
from dynmap_rl.envs.scene import SEEDS_PER_SPLIT, scene_seeds
from dynmap_rl.envs.task import Task
from dynmap_rl.envs.tasks import get_task
from dynmap_rl.envs.torchrl_env import DynmapBatchedEnv
from dynmap_rl.envs.world import EPISODE_STEPS, limit_actions
from dynmap_rl.experts.network import list_checkpoints, load_expert, task_of_expert
from dynmap_rl.modules.actor import Actor
from dynmap_rl.modules.world_model import WorldModel

from .settings import PolicyTraining

FIRST_SCENE = 1_000_000  # far from the scenes of demonstrations


@torch.no_grad()
def collect_corrections(actor: TensorDictModuleBase, task: str, seeds: list[int]) -> TensorDict:
    """Let a policy act in scenes, and record what the expert would have done in every state that it reaches.

    Args:
        actor: the policy with its world model, such as :class:`dynmap_rl.modules.Actor`.
        task: name of the task.
        seeds: seeds of the scenes.

    Returns:
        Episodes ``[E, 120]`` with ``pixels``, ``goal``, ``dynamics``, the policy's ``action`` as executed,
        ``expert_action``, and ``failed`` bool ``[..., 1]``: steps after a failure, in which there is nothing to correct.
    """
    actor, device, count = actor.eval(), next(actor.parameters()).device, len(seeds)
    env = DynmapBatchedEnv(task, count, from_pixels=True, device=device)
    network, rules = load_expert(task), task_of_expert(task, env.task)
    td = env.reset(TensorDict({"scene_seed": torch.tensor(seeds)}, [count]))
    steps = []
    for _ in tqdm(range(EPISODE_STEPS), f"corrections in {count} scenes", unit="step", leave=False):
        worlds = env.worlds
        failed = torch.tensor([[env.task.is_over(world)] for world in worlds])
        state = torch.from_numpy(np.stack([rules.state(world) for world in worlds]))
        wanted = [w.action_for(a) for w, a in zip(worlds, network(state)[0].numpy(), strict=True)]
        expert_action = limit_actions(worlds, np.stack(wanted)).astype(np.float32)
        td = env.step(actor(td))
        step = td.select("pixels", "goal", "dynamics").cpu().set("failed", failed)
        step["action"] = torch.from_numpy(np.stack([w.action for w in env.worlds]).astype(np.float32))
        step["expert_action"] = torch.from_numpy(expert_action)
        steps.append(step)
        td = step_mdp(td, keep_other=False)
    return torch.stack(steps, 1)


def check_corrections(settings: PolicyTraining, task: str | None, seeds: Sequence[int] = ()) -> None:
    """Raise ``ValueError`` if policies are to be corrected and there is no expert of the task, or no scene for a seed."""
    if not settings.corrections:
        if settings.correction_updates != PolicyTraining().correction_updates:
            raise ValueError(
                "PolicyTraining.correction_updates has no effect without corrections; leave it out"
            )
        return
    if task is None:
        raise ValueError("PolicyTraining.corrections need the expert of a task, got no task")
    get_task(task, kind=Task)
    list_checkpoints(task)
    largest = (SEEDS_PER_SPLIT - FIRST_SCENE) // settings.corrections - 1
    if max(seeds, default=0) > largest:
        raise ValueError(
            f"seeds must be at most {largest} with {settings.corrections} corrections, got {max(seeds)}"
        )


def add_corrections(
    features: TensorDict, world_model: WorldModel, policy: nn.Module, task: str, scenes: int, seed: int
) -> TensorDict:
    """Return training states ``[E, T]`` (see :func:`compute_features`) and those of corrections, ``[E + scenes, T]``.

    Args:
        features: training states so far.
        world_model: frozen world model of the states.
        policy: the policy that is corrected.
        task: name of the task, whose expert corrects.
        scenes: number of scenes.
        seed: chooses the scenes.
    """
    seeds = scene_seeds("train", scenes, start=FIRST_SCENE + seed * scenes)
    corrections = collect_corrections(Actor(world_model, policy, mixed=True), task, seeds)
    states = compute_features(world_model, corrections).to(features.device)
    states["disturbed"] |= corrections["failed"].to(states.device)
    return torch.cat([features, states])
