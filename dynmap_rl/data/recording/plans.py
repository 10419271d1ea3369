"""Plans of episodes, and rollouts of experts by these plans (paper, Sec. IV-C)."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from tensordict import TensorDict

from dynmap_rl.envs.scene import scene_seed
from dynmap_rl.envs.task import Task
from dynmap_rl.envs.tasks import get_task
from dynmap_rl.envs.torchrl_env import DynmapBatchedEnv
from dynmap_rl.envs.world import EPISODE_STEPS, LARGEST_CHANGE, World, limit_actions
from dynmap_rl.experts.network import list_checkpoints, load_expert, task_of_expert

from .demonstrators import demonstrate

SCRIPTED = "scripted"  # in the place of a checkpoint
KEYS = [
    "pixels",
    "agent_pos",
    "goal",
    "dynamics",
    "action",
    "expert_action",
    *(("next", k) for k in ("reward", "done", "is_success", "dropped", "position_error")),
]

PUSH = 0.15  # largest acceleration of a push, as a share of the cart's limit


@dataclass(frozen=True)
class Plan:
    """Recipe of one episode.

    Attributes:
        scene_seed: seed of the scene.
        checkpoint: the expert's checkpoint.
        noise: standard deviation of the noise on the expert's acceleration, in units of the cart's limit.
        detours: number of other goals that the expert is sent to before the scene's goal.
        pushes: spans ``(start, end)`` of steps in which a push, a random acceleration, acts in the place of the expert,
            so that the demonstration shows how to recover.
    """

    scene_seed: int
    checkpoint: str
    noise: float = 0.0
    detours: int = 0
    pushes: tuple[tuple[int, int], ...] = ()


def plan_demonstrations(
    task: str,
    split: str,
    start: int,
    count: int,
    expert: str | Path | None = None,
    disturbed: bool = True,
) -> list[Plan]:
    """Plan demonstrations with the checkpoints in turn; two of three episodes have noise, one of three pushes too.

    Noise and pushes lead to states from which the expert must recover, as a policy will have to. A task with a
    demonstrator has no pushes.

    Args:
        task: name of the task.
        split: split of the scenes (see :func:`dynmap_rl.envs.scene.scene_seed`).
        start: number of the first scene in the split.
        count: number of episodes.
        expert: folder or task of the expert's checkpoints; by default the expert that ships for the task.
        disturbed: whether there are noise and pushes.
    """
    checkpoints, rules = find_checkpoints(task, expert), get_task(task)
    pushed = 0 if rules.has_demonstrator else rules.pushes
    plans = []
    for i in range(start, start + count):
        seed = scene_seed(split, i)
        pushes = draw_pushes(seed, pushed) if disturbed and i % 3 == 1 else ()
        checkpoint = checkpoints[(i // 3) % len(checkpoints)]
        plans.append(Plan(seed, checkpoint, noise=disturbed * (0.0, 0.05, 0.1)[i % 3], pushes=pushes))
    return plans


def plan_exploration(
    task: str, split: str, start: int, count: int, expert: str | Path | None = None
) -> list[Plan]:
    """Plan episodes of noisy experts on detours, which are not to be imitated.

    Args:
        task: name of the task.
        split: split of the scenes (see :func:`dynmap_rl.envs.scene.scene_seed`).
        start: number of the first scene in the split.
        count: number of episodes.
        expert: folder or task of the expert's checkpoints; by default the expert that ships for the task.
    """
    checkpoints, detours = find_checkpoints(task, expert), 0 if get_task(task).has_demonstrator else 3
    return [
        Plan(
            scene_seed(split, i),
            checkpoints[i % len(checkpoints)],
            noise=(0.1, 0.2, 0.4)[i % 3],
            detours=detours,
        )
        for i in range(start, start + count)
    ]


def find_checkpoints(task: str, expert: str | Path | None = None) -> list[str]:
    """Return the names of the checkpoints of an expert, earliest first; a task with a demonstrator has one name.

    Args:
        task: name of the task.
        expert: folder or task of the expert's checkpoints; by default the expert of the task.

    Raises:
        ValueError: there is no checkpoint, or the task has a demonstrator and another expert is given.
    """
    if not get_task(task).has_demonstrator:
        return list_checkpoints(expert or task)
    if expert not in (None, task):
        raise ValueError(f"--expert has no effect with {task}, which has an expert of its own; leave it out")
    return [SCRIPTED]


def run_plans(task: str, plans: list[Plan], expert: str | Path | None = None) -> TensorDict:
    """Run the plans as one batch.

    Args:
        task: name of the task.
        plans: one plan for each episode.
        expert: folder or task of the checkpoints that the plans name; by default the expert that ships for the task.

    Returns:
        ``[E, T]`` with ``pixels``, ``agent_pos``, ``goal``, ``dynamics``, ``action`` as executed, ``expert_action``
        without noise and pushes, and under ``next`` ``reward``, ``done``, ``is_success``, ``dropped``, ``position_error``.
    """
    if get_task(task).has_demonstrator:
        return demonstrate(task, [plan.scene_seed for plan in plans], [plan.noise for plan in plans])
    n = len(plans)
    env = DynmapBatchedEnv(task, n, from_pixels=True)
    td = env.reset(TensorDict({"scene_seed": torch.tensor([p.scene_seed for p in plans])}, [n]))
    rules = task_of_expert(expert or task, env.task)
    networks = {name: load_expert(expert or task, name) for name in sorted({p.checkpoint for p in plans})}
    rngs = [np.random.default_rng([p.scene_seed, 1]) for p in plans]
    detours = _detour_goals(plans, rngs)
    steps = []
    for t in range(EPISODE_STEPS):
        state = np.stack([rules.state(world) for world in env.worlds])
        for row in np.flatnonzero(~np.isnan(detours[:, t, 0])):
            state[row] = _state_for(rules, env.worlds[row], detours[row, t])
        acceleration = _expert_acceleration(torch.from_numpy(state), plans, networks)
        action = np.stack([w.action_for(a) for w, a in zip(env.worlds, acceleration, strict=True)])
        expert_action = limit_actions(env.worlds, action)
        _add_noise(action, plans, rngs)
        push(t, action, plans, env.worlds)
        td = env.step(td.set("action", torch.from_numpy(action.astype(np.float32))))
        executed = np.stack([w.action for w in env.worlds]).astype(np.float32)
        td["action"] = torch.from_numpy(executed)
        td["expert_action"] = torch.from_numpy(expert_action.astype(np.float32))
        steps.append(td.select(*KEYS))
        td = td["next"]
    return torch.stack(steps, 1)


def mark_pushes(plans: list[Plan], steps: int = EPISODE_STEPS) -> torch.Tensor:
    """Return in which of the ``steps`` steps a push acts, bool ``[E, steps, 1]``."""
    disturbed = torch.zeros(len(plans), steps, 1, dtype=torch.bool)
    for row, plan in enumerate(plans):
        for start, end in plan.pushes:
            disturbed[row, start:end] = True
    return disturbed


def _state_for(task: Task, world: World, goal: np.ndarray) -> np.ndarray:
    """Return the state that the world would have with another goal."""
    own, world.goal = world.goal, goal
    state = task.state(world)
    world.goal = own
    return state


def _expert_acceleration(state, plans, networks) -> np.ndarray:
    # Row by row: on some CPUs the last bits of a product of matrices depend on the number of rows, and an episode must
    # be the same in any batch.
    out = np.empty((len(plans), 3))
    for row, plan in enumerate(plans):
        out[row] = networks[plan.checkpoint](state[row])[0].numpy()
    return out


def _add_noise(action: np.ndarray, plans: list[Plan], rngs) -> None:
    for row, plan in enumerate(plans):
        action[row] += plan.noise * LARGEST_CHANGE * rngs[row].standard_normal(3)


def push(t: int, action: np.ndarray, plans: list[Plan], worlds: list[World]) -> None:
    """Replace actions by pushes, each a constant acceleration that the expert can make up for.

    Args:
        t: step.
        action: actions ``[E, 3]`` of all episodes, changed in place.
        plans: plans of the episodes; ``scene_seed`` and ``pushes`` are used.
        worlds: worlds of the episodes.
    """
    for row, plan in enumerate(plans):
        for number, (start, end) in enumerate(plan.pushes):
            if start <= t < end:
                rng = np.random.default_rng([plan.scene_seed, 3, number])
                action[row] = worlds[row].action + PUSH * LARGEST_CHANGE * rng.uniform(-1, 1, 3)


def draw_pushes(scene_seed: int, number: int) -> tuple[tuple[int, int], ...]:
    """Draw spans ``(start, end)`` of pushes, most of them early, while the cart is on its way."""
    rng = np.random.default_rng([scene_seed, 2])
    starts = np.sort(rng.exponential(30, number).astype(int).clip(0, EPISODE_STEPS - 25))
    return tuple((int(t), int(t + rng.integers(2, 7))) for t in starts)


def _detour_goals(plans: list[Plan], rngs) -> np.ndarray:
    """Draw goals ``[E, 120, 2]`` of the detours (m), each for 20 to 40 steps from the start; NaN afterwards."""
    goals = np.full((len(plans), EPISODE_STEPS, 2), np.nan)
    for row, (plan, rng) in enumerate(zip(plans, rngs, strict=True)):
        t = 0
        for _ in range(plan.detours):
            end = t + int(rng.integers(20, 41))
            goals[row, t:end] = rng.uniform((0.15, 0.08), (0.85, 0.75))
            t = end
    return goals
