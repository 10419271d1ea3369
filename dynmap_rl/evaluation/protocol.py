"""The two protocols of evaluation in closed loop, and their rows in ``eval.json`` (paper, Sec. V-B)."""

from __future__ import annotations

import pickle
from collections.abc import Callable
from functools import partial
from itertools import chain

import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModuleBase
from torch import nn

from dynmap_rl.envs.delay import FrameDelay
from dynmap_rl.envs.scene import scene_seeds
from dynmap_rl.envs.tasks import get_task
from dynmap_rl.modules.actor import Actor
from dynmap_rl.modules.world_model import WorldModel
from dynmap_rl.utils.processes import map_processes

from .failures import failure_causes
from .rollout import episode_rows, find_device, roll_out
from .settings import SHARED_STARTS, Evaluation
from .statistics import summarize

FLAGS = "success", "dropped", "touched"
BATCH = 100  # episodes of a batch on a CPU; larger ones are little faster, and are shared less evenly


def evaluate(
    actor: Callable[[TensorDict], TensorDict],
    task: str,
    settings: Evaluation | None = None,
    delay: FrameDelay | None = None,
    pushed: bool = False,
    workers: int = 1,
) -> dict[str, dict[str, dict]]:
    """Evaluate an actor in closed loop: on a CPU in batches of 100 episodes, on a GPU in one batch.

    Args:
        actor: see :func:`dynmap_rl.evaluation.roll_out`.
        task: name of the task.
        settings: scenes to evaluate on; default :class:`Evaluation`.
        delay: delay of the frames; see :func:`dynmap_rl.evaluation.roll_out`, also for the next.
        pushed: push the cart.
        workers: processes that share the batches of a CPU, each with one thread of torch. With one thread, the result
            does not depend on their number. A script that uses more than one must have the guard ``if __name__ == "__main__"``.

    Returns:
        ``test`` on the shared scenes of ``settings.split`` (under this name for every split) and, if ``settings.paper_episodes`` is not 0,
        ``paper`` on others. Each has ``summary`` (see :func:`dynmap_rl.evaluation.summarize`) and ``rows`` (see
        :func:`pack_rows`).

    Raises:
        ValueError: the actor cannot be sent to other processes.
        OSError: a process died.
    """
    settings = settings or Evaluation()
    seeds = scene_seeds(settings.split, settings.episodes)
    seeds += scene_seeds(settings.split, settings.paper_episodes, start=SHARED_STARTS)
    run = partial(roll_out, task=task, delay=delay, pushed=pushed)
    if find_device(actor).type == "cpu":
        rows = _judge_batches(actor, run, seeds, workers)
    else:
        rows = _judge_batch(lambda: actor, run, seeds, progress=True)
    parts = {"test": rows[: settings.episodes], "paper": rows[settings.episodes :]}
    return {
        name: {"summary": summarize(part), "rows": pack_rows(part)} for name, part in parts.items() if part
    }


def _judge_batches(actor: TensorDictModuleBase, run: partial, seeds: list[int], workers: int) -> list[dict]:
    """Return the rows of all scenes, a batch after the other or in several processes."""
    # A task that limits its worlds divides the batches, and needs long to make new worlds.
    size = BATCH if get_task(run.keywords["task"]).max_worlds is None else 2 * BATCH
    batches = [seeds[start : start + size] for start in range(0, len(seeds), size)]
    judge, title = partial(_judge_batch, lambda: actor, run), f"batches of {size} episodes"
    if min(workers, len(batches)) <= 1:
        return list(chain.from_iterable(map_processes(judge, batches, 1, title)))
    judge, threads = partial(_judge_batch, partial(_load_actor, _pickle(actor)), run), torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        return list(chain.from_iterable(map_processes(judge, batches, workers, title)))
    finally:
        torch.set_num_threads(threads)


def _pickle(actor: TensorDictModuleBase) -> bytes:
    """Return the actor as bytes; as an argument of a process, each of its tensors would hold a file open.

    Raises:
        ValueError: the actor cannot be sent to another process.
    """
    try:
        return pickle.dumps(actor)
    except (pickle.PicklingError, AttributeError, TypeError) as error:
        raise ValueError(f"this actor cannot be evaluated by several processes ({error}); use one") from error


def _load_actor(actor: bytes) -> TensorDictModuleBase:
    torch.set_num_threads(1)
    return pickle.loads(actor)


def _judge_batch(
    load: Callable[[], TensorDictModuleBase], run: partial, seeds: list[int], progress: bool = False
) -> list[dict]:
    episodes = run(load(), seeds=seeds, progress=progress)
    causes = failure_causes(episodes, run.keywords["task"])
    rows = zip(episode_rows(episodes, seeds), causes, strict=True)
    return [row | ({"cause": cause} if cause else {}) for row, cause in rows]


def judge_in_closed_loop(
    world_model: WorldModel, policy: nn.Module, task: str, settings: Evaluation | None = None
) -> dict[str, dict[str, dict]]:
    """Evaluate a world model and its policy as one actor (see :func:`evaluate`)."""
    return evaluate(Actor(world_model, policy, mixed=True), task, settings)


def pack_rows(rows: list[dict]) -> dict:
    """Return episode rows of consecutive scenes as columns.

    Args:
        rows: see :func:`dynmap_rl.evaluation.episode_rows`; those of :func:`evaluate` also have the ``cause`` of a failure
            (see :func:`dynmap_rl.evaluation.failure_causes`).

    Returns:
        ``first_scene_seed``, a text of 0 and 1 for each of ``success``, ``dropped`` and ``touched``, the list
        ``position_error`` (m), and ``causes``, the indices of the failed episodes by cause.
    """
    causes: dict[str, list[int]] = {}
    for index, row in enumerate(rows):
        if "cause" in row:
            causes.setdefault(row["cause"], []).append(index)
    columns = {flag: "".join(str(int(row[flag])) for row in rows) for flag in FLAGS}
    errors = [round(row["position_error"], 4) for row in rows]
    first = rows[0]["scene_seed"]
    return {"first_scene_seed": first, **columns, "position_error": errors, "causes": causes}


def unpack_rows(columns: dict) -> list[dict]:
    """Return the episode rows that :func:`pack_rows` packed; older results have no causes."""
    flags = [[flag == "1" for flag in columns[name]] for name in FLAGS]
    values = zip(*flags, columns["position_error"], strict=True)
    names = "scene_seed", *FLAGS, "position_error"
    first = columns["first_scene_seed"]
    rows = [dict(zip(names, (first + i, *row), strict=True)) for i, row in enumerate(values)]
    for cause, indices in columns.get("causes", {}).items():
        for index in indices:
            rows[index]["cause"] = cause
    return rows


def result_rows(result: dict) -> list[list[dict]]:
    """Return, for every policy seed of an ``eval.json``, the episode rows on the shared start states."""
    return [unpack_rows(seed["test"]["rows"]) for seed in result["results"]]
