"""Demonstrations in a simulator of a task's own, with the task's demonstrator."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import lru_cache

import numpy as np
import torch
from tensordict import TensorDict

from dynmap_rl.envs.protocol import BaseTask, SimulatedWorld, check_action, check_world
from dynmap_rl.envs.task import Task
from dynmap_rl.envs.tasks import get_task
from dynmap_rl.envs.world import limit_actions
from dynmap_rl.keys import DYNAMICS


def demonstrate(task: str, seeds: Sequence[int], noise: Sequence[float] | None = None) -> TensorDict:
    """Run the demonstrator of a task, one episode after the other.

    Args:
        task: name of the task.
        seeds: seed of the scene of each episode.
        noise: standard deviation of the noise on the actions of each episode, in units of the largest action; by default
            none.

    Returns:
        ``[E, T]``, as :func:`dynmap_rl.data.recording.plans.run_plans` returns them.
    """
    rules, episodes = get_task(task), []
    draw, world = _open_simulator(task, type(rules))
    for seed, own in zip(seeds, noise or [0.0] * len(seeds), strict=True):
        world = rules.begin(seed, None, world)
        rows = list(_demonstrate(rules, draw, world, seed, own))
        steps = {key: torch.from_numpy(np.stack([row[key] for row in rows])) for key in rows[0]}
        episodes.append(TensorDict(steps, [len(rows)]).unflatten_keys("."))
    out = torch.stack(episodes)
    out["pixels"] = out["pixels"].permute(0, 1, 4, 2, 3)
    return out


@lru_cache(1)
def _open_simulator(task: str, kind: type) -> tuple[Callable, SimulatedWorld]:
    """Return a renderer and a world, which the next recordings of a task use again; loading takes up to a second.

    An episode is run twice, as a used world must not differ from a new one.

    Raises:
        ValueError: the scene's seed does not determine the start, or start and actions do not determine the episode.
    """
    rules = get_task(task)
    world, draw = rules.begin(0), rules.make_renderer()
    check_world(rules, world, np.array(draw(world)), state=False)
    rows = list(_demonstrate(rules, lambda world: None, world, 0))
    world = rules.begin(0, None, world)
    for t, row in enumerate(rows):
        past = np.concatenate([row["dynamics.position"], row["dynamics.velocity"], row["agent_pos"]])
        now = np.concatenate([world.position, world.velocity, rules.agent_pos(world)])
        if np.allclose(past, now, atol=1e-6 if t == 0 else 1e-3):
            rules.step([world], [row["action"]])
        elif t == 0:
            raise ValueError(
                f"a seed must determine the start of {task}, but two resets with one seed differ; use the seed in its reset"
            )
        else:
            raise ValueError(
                f"the same seed and actions must lead to the same episode of {task}, but after a reset they differ from "
                f"step {t} on; its reset must set all that the physics depend on, such as masses"
            )
    return draw, world


def _demonstrate(
    rules: BaseTask, draw: Callable, world: SimulatedWorld, seed: int, noise: float = 0.0
) -> Iterator[dict]:
    """Yield the steps of an episode as arrays; TensorDicts would take longer than the simulator."""
    rng, expert, layout = np.random.default_rng([seed, 1]), rules.demonstrator(world), rules.layout
    limit = np.array(layout.action_limit, np.float32)
    if not callable(expert):
        raise ValueError(f"the demonstrator of {rules.name} must return a function, got {expert!r}")
    for t in range(layout.steps):
        agent_pos = np.array(rules.agent_pos(world), np.float32)  # copies: a task may write into one array
        row = {
            "pixels": np.array(draw(world)),
            "agent_pos": agent_pos,
            "goal": agent_pos[-layout.goal_size :],
        }
        row |= {f"dynamics.{name}": getattr(world, name).astype(np.float32) for name in DYNAMICS}
        try:
            action = expert()
        except StopIteration as error:
            raise ValueError(
                f"the demonstrator of {rules.name} must act in every step, but ends in step {t}"
            ) from error
        what = f"an action of the demonstrator of {rules.name} (step {t}, scene {seed})"
        action = check_action(action, len(limit), what)
        change = noise * rng.standard_normal(len(limit)).astype(np.float32) * limit
        change = change * (not getattr(expert, "exact", False))
        row |= {"action": (action + change).clip(-limit, limit), "expert_action": action.clip(-limit, limit)}
        if isinstance(rules, Task):  # a cart has more limits
            row["expert_action"] = limit_actions([world], [action])[0].astype(np.float32)
        rules.step([world], [row["action"]])
        if isinstance(rules, Task):
            row["action"] = np.array(world.action, np.float32)
        end = {"done": t + 1 == layout.steps or rules.is_over(world), "dropped": world.dropped}
        end |= {"is_success": rules.is_success(world)}
        row |= {f"next.{name}": np.array([value], bool) for name, value in end.items()}
        values = {"reward": rules.reward(world), "position_error": world.position_error}
        yield row | {f"next.{name}": np.array([value], np.float32) for name, value in values.items()}
