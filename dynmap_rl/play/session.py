"""One world that a hand, an expert or a policy drives, and what a world model makes of it. No window is needed."""

from __future__ import annotations

from collections import defaultdict
from pathlib import Path

import numpy as np
import torch
from tensordict import TensorDict

from dynmap_rl.data.recording.plans import KEYS
from dynmap_rl.envs.scene import scene_seed
from dynmap_rl.envs.tasks import BalanceReaching
from dynmap_rl.envs.torchrl_env import DynmapBatchedEnv
from dynmap_rl.envs.world import ACTION_LIMIT, CONTROL_DT, EPISODE_STEPS
from dynmap_rl.experts.network import load_expert, task_of_expert
from dynmap_rl.modules.actor import Actor
from dynmap_rl.keys import DYNAMICS

DRIVERS = "hand", "expert", "policy"
HAND_ACCELERATION = np.array([1.5, 1.5, 4.0])  # m/s^2, m/s^2, rad/s^2: at the cart's limit a tall block tips
NEAR = 4.0  # 1/s, speed for each m of distance


class Hand:
    """What a person wants of the cart: a velocity by keys, or a place by the mouse.

    Attributes:
        direction: ``[3]`` of -1, 0 or 1: x, y, tilt.
        target: a place to go to (m), instead of x and y of the direction.
    """

    def __init__(self):
        self.direction = np.zeros(3)
        self.target: tuple[float, float] | None = None

    def action(self, commanded: np.ndarray, last: np.ndarray) -> np.ndarray:
        """The action ``[3]`` (m, m, rad), with a gentle acceleration from the last one."""
        wanted = self.direction * ACTION_LIMIT
        if self.target is not None:
            way = np.asarray(self.target) - commanded[:2]
            # The speed from which the cart can still stop there, and near it less, or it would go to and fro.
            brake = np.sqrt(2 * 0.7 * HAND_ACCELERATION[:2] * np.abs(way))
            speed = np.minimum(brake, NEAR * np.abs(way)) * CONTROL_DT
            wanted[:2] = np.sign(way) * np.minimum(speed, ACTION_LIMIT[:2])
        change = HAND_ACCELERATION * CONTROL_DT**2
        return last + np.clip(wanted - last, -change, change)


class Session:
    """Episodes of a task, one after the other, a control step at a time.

    Args:
        task: its name.
        actor: world model and policy; without it nothing is predicted and no policy drives.
        expert: of the task; by default the one that ships with the package, None where there is none.
        seed: number of the first scene.
        split: that scenes are of.

    Attributes:
        driver: one of ``hand``, ``expert``, ``policy``.
        imagining: whether the world model goes on without frames, by its own predictions, and the policy with it.
        hand: what the person wants.
        td: the present observation, ``[1]``.
        prediction: what the world model says of the present: ``pixels`` uint8 ``[64, 64, 3]`` and ``[6]`` by quantity;
            empty in the first step of an episode, and without a world model.
        trace: true and predicted dynamics of this episode: ``(quantity, "true" | "predicted")`` to rows ``[6]``, NaN
            where there is no prediction.
    """

    def __init__(
        self,
        task: str,
        actor: Actor | None = None,
        expert: str | Path | None = None,
        seed: int = 0,
        split: str = "validation",
    ):
        self.env = DynmapBatchedEnv(task, 1, from_pixels=True)
        self.actor, self.seed, self.split = actor, seed, split
        self.expert, self.expert_task = _find_expert(self.env.task, expert or task, named=expert is not None)
        self.driver, self.hand = "policy" if actor else "hand", Hand()
        self.restart(seed)

    @property
    def drivers(self) -> tuple[str, ...]:
        """Those that there are."""
        there = {"hand": True, "expert": self.expert is not None, "policy": self.actor is not None}
        return tuple(driver for driver in DRIVERS if there[driver])

    @property
    def world(self):
        """The simulated one."""
        return self.env.worlds[0]

    @property
    def over(self) -> bool:
        """Whether the episode's steps have passed."""
        return self.world.steps >= EPISODE_STEPS

    @property
    def succeeded(self) -> bool:
        """Whether the episode, as it stands, is a success."""
        return self.env.task.is_success(self.world)

    def restart(self, seed: int | None = None) -> None:
        """A new episode, of the next scene where none is named."""
        self.seed = self.seed + 1 if seed is None else seed
        seeds = torch.tensor([scene_seed(self.split, self.seed)])
        self.td = self.env.reset(TensorDict({"scene_seed": seeds}, [1]))
        self.scene_seed, self.imagining = int(seeds), False
        self.drove: set[str] = set()
        self.steps: list[TensorDict] = []
        self.trace = defaultdict(list)
        self.prediction: dict[str, np.ndarray] = {}
        if self.actor:
            self.states = None
            self.memory = self.actor.world_model.initial_state(1), self.actor.policy.initial_state(1)
        self._note()

    @torch.no_grad()
    def step(self) -> None:
        """One control step; none where the episode is over."""
        if self.over:
            return
        self.drove.add(self.driver)
        policy_action, latent = self._look() if self.actor else (None, None)
        action = {"hand": self._hand_action, "expert": self._expert_action, "policy": lambda: policy_action}
        wanted = self._as_tensor(action[self.driver]())
        td = self.env.step(self.td.set("action", wanted))
        if self.actor:
            self._predict(latent, wanted)  # as in an evaluation: before the cart's limits
        td["action"] = self._as_tensor(self.world.action)
        self.steps.append(td.select(*KEYS).clone())
        self.td = td["next"]
        self._note()

    def episode(self) -> TensorDict:
        """What was done so far, ``[1, T]``, with the entries of a demonstration."""
        return torch.stack(self.steps, 1)

    def _hand_action(self) -> np.ndarray:
        return self.hand.action(self.world.commanded, self.world.action)

    def _expert_action(self) -> np.ndarray:
        state = torch.from_numpy(self.expert_task.state(self.world))
        return self.world.action_for(self.expert(state)[0].numpy())

    def _as_tensor(self, action) -> torch.Tensor:
        return torch.as_tensor(np.asarray(action), dtype=torch.float32).reshape(1, 3)

    def _look(self) -> tuple[torch.Tensor, torch.Tensor]:
        """The policy's action, and the latent: of the frame or, in imagination, the predicted one."""
        world_model, (state, policy_state) = self.actor.world_model, self.memory
        blind = self.imagining and self.states is not None
        latent = self.states[0] if blind else world_model.encode(self.td["pixels"], self.actor.mixed)
        goal = self.td["goal"]
        action, policy_state = self.actor.policy.step(latent, state[0], state[2], goal, policy_state)
        self.memory = state, policy_state
        return action, latent

    def _predict(self, latent: torch.Tensor, action: torch.Tensor) -> None:
        world_model, (state, policy_state) = self.actor.world_model, self.memory
        predicted, state = world_model.step(latent, action, state)
        self.memory, self.states = (state, policy_state), (predicted, state[0], state[2])
        frame = world_model.decode_pixels(*self.states)[0].clamp(0, 1) * 255
        self.prediction = {"pixels": frame.round().byte().permute(1, 2, 0).numpy()}
        values = world_model.decode_dynamics(*self.states)
        self.prediction |= {quantity: value[0].numpy() for quantity, value in values.items()}

    def _note(self) -> None:
        for quantity in DYNAMICS:
            self.trace[quantity, "true"].append(self.td["dynamics", quantity][0].numpy())
            self.trace[quantity, "predicted"].append(self.prediction.get(quantity, np.full(6, np.nan)))


def _find_expert(task: BalanceReaching, name: str | Path, named: bool):
    """The expert of that name and the task whose state it sees; twice None where nobody named it and there is none."""
    try:
        expert = load_expert(name)
    except ValueError:
        if named:
            raise
        return None, None
    return expert, task_of_expert(name, task)
