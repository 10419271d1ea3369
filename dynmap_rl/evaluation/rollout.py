"""Closed-loop evaluation: all episodes as one batch (paper, Sec. V-B)."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModuleBase
from torchrl.envs.utils import step_mdp
from tqdm import tqdm

from dynmap_rl.envs.scene import scene_seed
from dynmap_rl.envs.torchrl_env import DynmapBatchedEnv
from dynmap_rl.envs.world import EPISODE_STEPS


def scene_seeds(split: str, count: int, start: int = 0) -> list[int]:
    """The seeds of scenes ``start .. start + count`` of a split."""
    return [scene_seed(split, start + i) for i in range(count)]


@torch.no_grad()
def roll_out(
    actor: TensorDictModuleBase, task: str, seeds: list[int], keep_pixels: bool = False
) -> TensorDict:
    """Run one episode of 120 steps for each scene seed, to the end also where the block is dropped.

    Args:
        actor: reads ``pixels``, ``goal`` or ``agent_pos`` and writes ``action``, as a :class:`dynmap_rl.modules.Actor`
            does.
        task: its name.
        seeds: of the scenes.
        keep_pixels: whether frames are in the result.

    Returns:
        A TensorDict ``[E, 120]`` with the environment's entries at t (``dynamics``, ``action``, ``goal``, ...;
        ``pixels`` only where kept) and ``("next", "position_error" | "dropped" | "touched" | "is_success")``; with a world model
        that decodes dynamics, also ``("predicted_dynamics", quantity)`` at t, its one-step prediction along
        these rollouts (zeros at t = 0).
    """
    actor = actor.eval()
    if hasattr(actor, "reset"):  # of LeRobot's policies, whose memory is their own
        actor.reset()
    device = next(actor.parameters()).device
    env = DynmapBatchedEnv(task, len(seeds), from_pixels=True, pixels_only=True, device=device)
    td = env.reset(TensorDict({"scene_seed": torch.tensor(seeds)}, [len(seeds)]))
    keys = [
        "action",
        "goal",
        "dynamics",
        *(("next", k) for k in ("position_error", "dropped", "touched", "is_success")),
    ]
    keys += ["pixels"] if keep_pixels else []
    steps = []
    world_model = getattr(actor, "world_model", None)
    quantities = world_model.supervision if world_model else ()
    predicted = {quantity: torch.zeros(len(seeds), 6, device=device) for quantity in quantities}
    for _ in tqdm(range(EPISODE_STEPS), f"{len(seeds)} episodes", unit="step", leave=False):
        td = env.step(actor(td))
        step = td.select(*keys)
        step["predicted_dynamics"] = TensorDict(predicted, [len(seeds)])
        steps.append(step)
        td = step_mdp(td, keep_other=False)
        if quantities:
            states = td["predicted_latent"], td["hidden1"], td["hidden2"]
            predicted = world_model.decode_dynamics(*states)
    return torch.stack(steps, 1).cpu()


def episode_rows(episodes: TensorDict, seeds: list[int]) -> list[dict]:
    """One JSON-ready row an episode: scene seed, dropped, touched a wall, position error (m), success, and, where the world model
    decodes positions, the mean distance between predicted and true cart position (m), in all steps and in those
    more than 0.1 m away from the goal."""
    last = episodes["next"][:, -1]
    rows = [
        {
            "scene_seed": seed,
            "dropped": bool(last["dropped"][i]),
            "touched": bool(last["touched"][i]),
            "position_error": round(last["position_error"][i].item(), 5),
            "success": bool(last["is_success"][i]),
        }
        for i, seed in enumerate(seeds)
    ]
    if "position" in episodes["predicted_dynamics"].keys():
        error = episodes["predicted_dynamics", "position"] - episodes["dynamics", "position"]
        error = error[:, 1:, :2].norm(dim=-1)  # [E, T - 1]
        away = (episodes["dynamics", "position"][..., :2] - episodes["goal"])[:, 1:].norm(dim=-1) > 0.1
        away_error = (error * away).sum(1) / away.sum(1).clamp(min=1)
        for row, value, value_away in zip(rows, error.mean(1).tolist(), away_error.tolist(), strict=True):
            row["localization_error"] = round(value, 5)
            row["localization_error_away"] = round(value_away, 5)
    return rows


def failures_first(seeds: Sequence[int], success: Sequence[bool], count: int = 8) -> list[int]:
    """``count`` of the scene seeds to look at: failures, then successes, half of each where there are as many."""
    pairs = list(zip(seeds, success, strict=True))
    failed, others = ([seed for seed, good in pairs if good == wanted] for wanted in (False, True))
    failed = failed[: max(count // 2, count - len(others))]
    return failed + others[: count - len(failed)]
