"""Closed-loop rollouts: all episodes as one batch (paper, Sec. V-B)."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, contextmanager, nullcontext

import torch
from tensordict import TensorDict
from torch import nn
from torchrl.envs import Compose, RenameTransform, TransformedEnv
from torchrl.envs.utils import step_mdp
from tqdm import tqdm

from dynmap_rl.data.recording.plans import Plan, draw_pushes, push
from dynmap_rl.envs.delay import FrameDelay, check_delay
from dynmap_rl.envs.delay_transform import DelayTransform
from dynmap_rl.envs.protocol import BaseTask
from dynmap_rl.envs.task import Task
from dynmap_rl.envs.tasks import get_task
from dynmap_rl.envs.torchrl_env import DynmapBatchedEnv
from dynmap_rl.modules.actor import Actor
from dynmap_rl.modules.delayed_actor import DelayedActor
from dynmap_rl.modules.policy import FeedforwardPolicy, RecurrentPolicy

from .still import reuse_still_frames

EVENTS = tuple(("next", key) for key in ("position_error", "dropped", "touched", "is_success"))


@torch.no_grad()
def roll_out(
    actor: Callable[[TensorDict], TensorDict],
    task: str,
    seeds: Sequence[int],
    keep_pixels: bool = False,
    delay: FrameDelay | None = None,
    pushed: bool = False,
    progress: bool = True,
) -> TensorDict:
    """Run one episode of T steps (120 of cart and block) for each scene; an episode goes on after a failure.

    All episodes are one batch or, where a task limits its worlds, a few batches. What an actor draws with torch's generator
    follows from the seeds.

    Args:
        actor: callable that reads ``pixels``, ``goal``, ``agent_pos`` or ``is_init`` of a TensorDict ``[E]`` and writes
            ``action``, as :class:`dynmap_rl.modules.Actor` does. What it writes under ``next`` is there in the next step.
        task: name of the task.
        seeds: seeds of the scenes.
        keep_pixels: keep the frames in the result, each at the step at which it was taken.
        delay: delay of the frames, which are the same for the same scenes. A :class:`dynmap_rl.modules.DelayedActor`
            gets every frame that arrives; any other actor gets the newest that has arrived.
        pushed: execute pushes in the place of some actions, which the actor is not told. They are as many and as strong
            as in disturbed demonstrations, and the same for the same scenes. Needs a task of cart and block.
        progress: show a progress bar.

    Returns:
        A TensorDict ``[E, T]`` with ``action``, ``goal`` and ``dynamics`` at t, ``pixels`` if they are kept, and
        ``("next", "position_error" | "dropped" | "touched" | "is_success")``. ``("predicted_dynamics", quantity)`` is the
        one-step prediction of the actor's world model at t, zero at t = 0, for each quantity that it decodes.

    Raises:
        ValueError: the actor is of other sizes than the task, has too short a memory for the delay, or takes frames for
            late without one; ``delay`` is no :class:`FrameDelay`; or the task knows no pushes.
    """
    module = actor if isinstance(actor, nn.Module) else nn.Module()
    seeds, rules, device = [int(seed) for seed in seeds], get_task(task), find_device(actor)
    check_actor(actor, rules)
    if delay is not None:
        check_delay(delay)
    elif isinstance(actor, DelayedActor) and actor.delay:
        raise ValueError(
            f"the actor's delay of {actor.delay} steps needs frames with it, such as FrameDelay({actor.delay})"
        )
    if delay and isinstance(actor, DelayedActor):
        youngest = delay.steps - delay.jitter + delay.error
        if youngest > actor.max_delay:
            raise ValueError(
                f"max_delay of the actor must be at least {youngest} steps, the age of the youngest frames, got "
                f"{actor.max_delay}"
            )
    if pushed and not isinstance(rules, Task):
        raise ValueError(f"pushed needs a task of cart and block, got {task}")
    pushes = rules.pushes if pushed else 0
    size = min(len(seeds), rules.max_worlds or len(seeds))
    env = DynmapBatchedEnv(task, size, from_pixels=True, include_state=False, device=device)
    parts, title = [], f"{len(seeds)} episodes" if progress else None
    with closing(env):
        for start in range(0, len(seeds), size):
            some = seeds[start : start + size]
            full = some + seeds[: size - len(some)]  # a batch always has the same size
            plans = [Plan(seed, "", pushes=draw_pushes(seed, pushes)) for seed in full]
            still = reuse_still_frames(module) if device.type == "cpu" else nullcontext()
            with (
                evaluation_mode(module),
                still,
                torch.random.fork_rng([device] if device.type == "cuda" else []),
            ):
                torch.manual_seed(some[0])
                episodes = _roll_out(actor, env, plans, keep_pixels, delay, title)
            parts.append(episodes[: len(some)])
    return torch.cat(parts)


def check_actor(actor: Callable, task: BaseTask) -> None:
    """Raise ``ValueError`` where the world model and policy of an actor have other sizes than the task's layout."""
    if not isinstance(actor, Actor | DelayedActor):
        return
    world_model, layout = actor.world_model, task.layout
    policy = (actor.actor if isinstance(actor, DelayedActor) else actor).latent_actor.policy
    own = {
        "action": (world_model.transition.action.size, len(layout.action)),
        "frame side": (world_model.image_size, layout.image_size),
        "cameras": (world_model.cameras, len(layout.cameras)),
    }
    if isinstance(policy, FeedforwardPolicy | RecurrentPolicy):  # others may have a goal of another form
        own["goal"] = policy.goal.size, layout.goal_size
    wrong = [f"{name} {found} instead of {size}" for name, (found, size) in own.items() if found != size]
    if wrong:
        raise ValueError(f"the policy must be of {task.name}, got another one: {', '.join(wrong)}")


@contextmanager
def evaluation_mode(module: nn.Module) -> Iterator[None]:
    """Set all parts of a module to evaluation, and back to what they were at the end."""
    modes = {part: part.training for part in module.modules()}
    try:
        for part in modes:
            part.training = False
        yield
    finally:
        for part, training in modes.items():
            part.training = training


def find_device(actor: Callable) -> torch.device:
    """Return the device of an actor; the CPU of one without parameters."""
    parameters = actor.parameters() if isinstance(actor, nn.Module) else ()
    return next((parameter.device for parameter in parameters), torch.device("cpu"))


def _roll_out(
    actor: Callable[[TensorDict], TensorDict],
    env: DynmapBatchedEnv,
    plans: list[Plan],
    keep_pixels: bool,
    delay: FrameDelay | None,
    title: str | None,
) -> TensorDict:
    """Run one episode in every world of an environment by scene and pushes of its plan, ``[E, T]``."""
    if hasattr(actor, "reset"):  # a LeRobot policy keeps its memory itself
        actor.reset()
    count, device, seeds = len(plans), env.device, [plan.scene_seed for plan in plans]
    if delay:
        late = DelayTransform(delay, seeds, bursts=isinstance(actor, DelayedActor))
        env = TransformedEnv(env, Compose(RenameTransform(["pixels"], ["present"], create_copy=True), late))
    pixels = "present" if delay else "pixels"
    keys = ["action", "goal", *EVENTS, *([pixels] if keep_pixels else [])]
    td = env.reset(scene_seed=torch.tensor(seeds))
    own = actor.actor if isinstance(actor, DelayedActor) else actor
    sizes = own.world_model.sizes if isinstance(own, Actor) else {}
    predicted = {quantity: torch.zeros(count, size, device=device) for quantity, size in sizes.items()}
    pushed, steps = any(plan.pushes for plan in plans), []
    bar = {} if title else {"disable": True}  # False would override TQDM_DISABLE
    for t in tqdm(range(env.layout.steps), title, unit="step", leave=False, **bar):
        dynamics = env.read_dynamics()
        td["is_init"] = torch.full((count, 1), t == 0, device=device)
        td = td.update(actor(td))
        if pushed:
            action = td["action"].double().cpu().numpy()
            push(t, action, plans, env.worlds)
            td["action"] = torch.as_tensor(action, dtype=torch.float32, device=device)
        td = env.step(td)
        step = td.select(*keys).set("dynamics", dynamics)
        steps.append(step.set("predicted_dynamics", TensorDict(predicted, [count])))
        td = step_mdp(td, keep_other=False)
        if sizes:
            states = td[own.predicted_latent], td[own.memory[0]], td[own.memory[2]]
            predicted = own.world_model.decode_dynamics(*states)
    episodes = torch.stack(steps, 1).cpu()
    return episodes.rename_key_(pixels, "pixels") if keep_pixels else episodes


def episode_rows(episodes: TensorDict, seeds: list[int]) -> list[dict]:
    """Return one JSON-ready row an episode.

    Args:
        episodes: result of :func:`roll_out`.
        seeds: seeds of its scenes.

    Returns:
        Rows with ``scene_seed``, ``dropped``, ``touched`` (cart or block touched a wall of an obstacle or bin),
        ``position_error`` (m) and ``success``. If the world model decodes positions of all bodies,
        ``localization_error`` is the mean distance between predicted and true position of the first body, the cart or
        the object of a MuJoCo task (m).
    """
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
    truth, predicted = (episodes[key].get("position", None) for key in ("dynamics", "predicted_dynamics"))
    axes = episodes["goal"].shape[-1]
    # A world model may know other entries, and the goal of a task of one's own may be no point.
    if predicted is not None and predicted.shape == truth.shape and axes in (2, 3):
        error = predicted - truth
        error = error[:, 1:, :axes].norm(dim=-1)  # [E, T - 1]
        for row, value in zip(rows, error.mean(1).tolist(), strict=True):
            row["localization_error"] = round(value, 5)
    return rows


def failures_first(
    seeds: Sequence[int], success: Sequence[bool], count: int = 8, alone: bool = False
) -> list[int]:
    """Return ``count`` scene seeds, failures first; half of them are failures if there are enough of both.

    With ``alone``, they are failures alone, where there are any.
    """
    pairs = list(zip(seeds, success, strict=True))
    failed, others = ([seed for seed, good in pairs if good == expected] for expected in (False, True))
    if alone and failed:
        return failed[:count]
    failed = failed[: max(count // 2, count - len(others))]
    return failed + others[: count - len(failed)]
