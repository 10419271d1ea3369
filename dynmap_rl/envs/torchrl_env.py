"""The tasks as one batched TorchRL environment: many worlds in one process."""

from __future__ import annotations

import itertools
from collections.abc import Iterable

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.data import Binary, Bounded, Composite, Unbounded
from torchrl.envs import EnvBase

from dynmap_rl.keys import DYNAMICS

from .gym_env import ACTION_LIMITS
from .protocol import BaseTask, SimulatedWorld, check_action, check_world
from .scene import SceneRanges, choose_ranges
from .task import Task
from .tasks import get_task

EVENTS = ("dropped", "touched", "is_success")


class DynmapBatchedEnv(EnvBase):
    """``num_envs`` worlds of a task as a TorchRL environment of batch size ``[num_envs]``.

    The sizes below are those of the tasks of cart and block. Other tasks have the sizes of their layout (see
    :class:`dynmap_rl.envs.Layout`).

    The class :class:`dynmap_rl.envs.DynmapEnv` specifies actions, rewards, success and the end of an episode. The same
    seeds and actions give the same trajectories as the Gymnasium ids, with any ``num_envs``. The environment does not
    reset worlds by itself; as in all of TorchRL, a rollout or a collector does.

    Action: ``action`` float32 ``[N, 3]`` (SI units, see ``control``). The action that is executed within the cart's limits
    is the change of ``agent_pos[..., :3]``.

    Observation: ``agent_pos`` ``[N, 5]`` (commanded cart pose x, y, theta and the goal; m, m, rad, m, m), ``goal``
    ``[N, 2]`` (m), ``dropped``, ``touched`` and ``is_success`` bool ``[N, 1]``, ``position_error`` ``[N, 1]`` (m).
    With ``include_state`` also the privileged ``state`` ``[N, S]`` and
    ``("dynamics", "position" | "velocity" | "acceleration")`` ``[N, 6]`` (SI units; cart x, y, theta, block x, y,
    theta). With ``from_pixels`` also ``pixels`` uint8 ``[N, 3, 64, 64]``.

    Reset: scenes are drawn from the environment's seed. ``env.reset(scene_seed=torch.arange(n))`` gives each world the
    scene of a seed of its own instead, as does an entry ``scene_seed`` ``[N]`` (int64) of the TensorDict that is
    passed to ``reset``. A ``TransformedEnv`` forwards the argument but not the entry; a ``ParallelEnv`` forwards
    ``env.reset(list_of_kwargs=[{"scene_seed": ...}, ...])``, one for each process.

    Args:
        task: name of the task, or ``"module:Class"`` of your own (see :class:`dynmap_rl.envs.BaseTask`).
        num_envs: number of worlds N.
        from_pixels: draw a frame in each step.
        control: ``position`` or, in tasks of cart and block, ``acceleration`` (see :class:`dynmap_rl.envs.DynmapEnv`).
        ranges: ranges from which scenes are drawn; by default the task's own.
        seed: seed of the scenes.
        device: device of the TensorDicts; worlds are simulated on the CPU.
        include_state: include the privileged ``state`` and ``dynamics``. Without them no policy can read them, and
            steps are faster.

    Raises:
        ValueError: ``num_envs``, ``task``, ``control`` or ``ranges`` is not valid.
    """

    batch_locked = True

    def __init__(
        self,
        task: str = "balance_reaching",
        num_envs: int = 1,
        from_pixels: bool = False,
        control: str = "position",
        ranges: SceneRanges | None = None,
        seed: int | None = None,
        device: torch.device | str = "cpu",
        include_state: bool = True,
    ):
        if num_envs < 1:
            raise ValueError(f"num_envs must be at least 1, got {num_envs}")
        if control not in ACTION_LIMITS:
            raise ValueError(f"control must be one of {sorted(ACTION_LIMITS)}, got {control!r}")
        super().__init__(device=device, batch_size=[num_envs])
        self.task = get_task(task, kind=BaseTask if control == "position" else Task)
        self.layout = self.task.layout
        self.control = control
        self.ranges = choose_ranges(self.task.ranges, ranges)
        self.draw = self.task.make_renderer() if from_pixels else None
        self.include_state = include_state
        self.worlds: list[SimulatedWorld | None] = [None] * num_envs
        self._checked = False
        self._make_specs()
        self.set_seed(seed)

    def _make_specs(self) -> None:
        n, device = self.batch_size[0], self.device

        def unbounded(*shape, dtype=torch.float32):
            return Unbounded((n, *shape), dtype=dtype, device=device)

        observation = {
            "agent_pos": unbounded(len(self.layout.state)),
            "goal": unbounded(self.layout.goal_size),
            "position_error": unbounded(1),
            **{name: Binary(1, (n, 1), dtype=torch.bool, device=device) for name in EVENTS},
        }
        if self.include_state:
            observation["state"] = unbounded(self.task.state_size)
            dynamics = {name: unbounded(len(entries)) for name, entries in self.layout.dynamics.items()}
            observation["dynamics"] = Composite(dynamics, shape=(n,), device=device)
        if self.draw:
            shape = n, *self.layout.frame_shape
            observation["pixels"] = Bounded(0, 255, shape, dtype=torch.uint8, device=device)
        self.observation_spec = Composite(observation, shape=(n,), device=device)
        limit = self.layout.action_limit if self.control == "position" else ACTION_LIMITS[self.control]
        limit = torch.as_tensor(limit, dtype=torch.float32).expand(n, -1)
        self.action_spec = Bounded(-limit, limit, limit.shape, dtype=torch.float32, device=device)
        self.reward_spec = unbounded(1)
        flags = {
            k: Binary(1, (n, 1), dtype=torch.bool, device=device) for k in ("done", "terminated", "truncated")
        }
        self.done_spec = Composite(flags, shape=(n,), device=device)

    def _set_seed(self, seed: int | None) -> None:
        self.rng = np.random.default_rng(seed)

    def _reset(
        self,
        tensordict: TensorDictBase | None = None,
        scene_seed: torch.Tensor | None = None,
        **kwargs,
    ) -> TensorDictBase:
        if kwargs:
            raise TypeError(
                f"reset takes scene_seed, got {', '.join(sorted(kwargs))}; a seed goes to set_seed"
            )
        n = self.batch_size[0]
        mask = torch.ones(n, dtype=torch.bool)
        seeds = scene_seed
        if tensordict is not None:
            if (flags := tensordict.get("_reset", None)) is not None:
                mask = flags.reshape(n).cpu()
            seeds = tensordict.get("scene_seed", scene_seed)
        if seeds is not None and (shape := tuple(np.shape(seeds))) != (n,):
            raise ValueError(
                f"scene_seed must have shape ({n},), one seed for each world, got {shape}; "
                "pass those of a ParallelEnv as list_of_kwargs"
            )
        if seeds is not None and ((given := torch.as_tensor(seeds)).is_floating_point() or (given < 0).any()):
            raise ValueError(f"scene_seed must be integers of at least 0, got {seeds}")
        rows = mask.nonzero().flatten().tolist()
        if len(rows) < n and None in self.worlds:
            raise RuntimeError("the environment has not begun; reset all worlds first")
        for i in rows:
            seed = int(seeds[i]) if seeds is not None else int(self.rng.integers(2**63))
            self.worlds[i] = self.task.begin(seed, self.ranges, self.worlds[i])
        if rows and not self._checked:
            world = self.worlds[rows[0]]
            check_world(
                self.task, world, np.array(self.draw(world)) if self.draw else None, self.include_state
            )
            self._checked = True
        self._update(rows)
        return self._observation.clone()

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        if None in self.worlds:
            raise RuntimeError("the environment has not begun; call reset first")
        # Without the worlds that TorchRL holds, such as those that have ended in a chunk of actions.
        mask = tensordict.get("_step", torch.ones(self.batch_size, dtype=torch.bool))
        rows = mask.reshape(-1).nonzero().flatten().tolist()
        worlds = [self.worlds[i] for i in rows]
        action = tensordict["action"].detach().cpu()
        # NumPy has no bfloat16.
        actions = action.to(torch.promote_types(action.dtype, torch.float32)).numpy()[rows]
        if not isinstance(self.task, Task):
            limit = np.array(self.layout.action_limit, np.float32)
            actions = [check_action(action, len(limit)).clip(-limit, limit) for action in actions]
        elif self.control == "acceleration":
            actions = [world.action_for(a) for world, a in zip(worlds, actions, strict=True)]
        self.task.step(worlds, actions)
        self._update(rows)
        reward = torch.zeros(*self.batch_size, 1, dtype=torch.float32)
        reward[rows] = torch.tensor([[self.task.reward(world)] for world in worlds], dtype=torch.float32)
        return self._observation.clone().set("reward", reward.to(self.device))

    def _update(self, rows: list[int]) -> None:
        """Observe some of the worlds. Callers may change what they get, so the last observation is kept apart."""
        if len(rows) == len(self.worlds):
            self._observation = self._observe(self.worlds)
        elif rows:
            self._observation[rows] = self._observe([self.worlds[i] for i in rows])

    def close(self, *, raise_if_closed: bool = True) -> None:
        """Close the worlds' simulators."""
        for world in self.worlds:
            if world is not None:
                self.task.close(world)
        self.worlds = [None] * len(self.worlds)
        super().close(raise_if_closed=raise_if_closed)

    def read_dynamics(self) -> TensorDict:
        """Read the dynamics of all worlds from the simulator, for measurements.

        Returns:
            TensorDict ``[N]`` with ``position``, ``velocity`` and ``acceleration`` ``[N, 6]`` (SI units; cart x, y,
            theta, block x, y, theta), the same values as the observation ``dynamics`` has with ``include_state``.
        """
        return TensorDict(self._read_dynamics(self.worlds), self.batch_size, device=self.device)

    def _observe(self, worlds: list[SimulatedWorld]) -> TensorDict:
        """Return observations and done flags of some of the worlds."""
        task = self.task
        agent_pos = _stack((task.agent_pos(w) for w in worlds), len(worlds))
        flags = np.array([self._flags(w) for w in worlds], dtype=bool)
        flags = dict(
            zip((*EVENTS, "terminated", "truncated"), torch.from_numpy(flags).split(1, 1), strict=True)
        )
        data = {
            "agent_pos": agent_pos,
            "goal": agent_pos[:, agent_pos.shape[1] - self.layout.goal_size :],
            "position_error": torch.tensor([[w.position_error] for w in worlds], dtype=torch.float32),
            "done": flags["terminated"] | flags["truncated"],
            **flags,
        }
        if self.include_state:
            data["state"] = _stack((task.state(w) for w in worlds), len(worlds))
            data["dynamics"] = self._read_dynamics(worlds)
        if self.draw:
            frames = np.stack(
                [np.array(self.draw(w)) for w in worlds]
            )  # copies: a renderer may use one array
            data["pixels"] = torch.from_numpy(frames).permute(0, 3, 1, 2)
        return TensorDict(data, batch_size=[len(worlds)], device=self.device)

    def _flags(self, world: SimulatedWorld) -> tuple[bool, ...]:
        task = self.task
        ended = task.is_over(world), world.steps >= self.layout.steps
        return world.dropped, bool(world.touched), task.is_success(world), *ended

    def _read_dynamics(self, worlds: list[SimulatedWorld]) -> dict[str, torch.Tensor]:
        vectors = itertools.chain.from_iterable((w.position, w.velocity, w.acceleration) for w in worlds)
        sizes = [len(entries) for entries in self.layout.dynamics.values()]
        return dict(zip(DYNAMICS, _stack(vectors, len(worlds)).split(sizes, 1), strict=True))


def _stack(vectors: Iterable[np.ndarray], count: int) -> torch.Tensor:
    """Return ``count`` rows of consecutive vectors as one float32 array; three times as fast as ``np.stack``."""
    array = np.concatenate(list(vectors), dtype=np.float32, casting="same_kind")
    return torch.from_numpy(array.reshape(count, -1))
