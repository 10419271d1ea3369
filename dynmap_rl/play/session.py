"""One world that a person, an expert or a policy drives, and the predictions of a world model; without a window."""

from __future__ import annotations

from collections import defaultdict, deque
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from tensordict import TensorDict

from dynmap_rl.data.recording.plans import KEYS
from dynmap_rl.envs.protocol import BaseTask, check_action
from dynmap_rl.envs.scene import scene_seed
from dynmap_rl.envs.task import Task
from dynmap_rl.envs.torchrl_env import DynmapBatchedEnv
from dynmap_rl.envs.world import ACTION_LIMIT, CONTROL_DT
from dynmap_rl.evaluation.rollout import check_actor
from dynmap_rl.experts.network import load_expert, task_of_expert
from dynmap_rl.keys import DYNAMICS
from dynmap_rl.modules.actor import Actor
from dynmap_rl.modules.delayed_actor import DelayedActor

DRIVERS = "person", "expert", "policy"
ACCELERATION = np.array([1.5, 1.5, 4.0])  # m/s^2, m/s^2, rad/s^2: at the cart's limit a tall block tips
MAX_DELAY = 20  # control steps
NEAR = 4.0  # 1/s, speed for each m of distance


class Person:
    """Input of a person: a direction by keys, or a place by the mouse.

    Attributes:
        direction: ``[3]`` of -1, 0 or 1: right, up in the picture, and tilt or, in space, up.
        target: place to go to (m), in place of x and y of the direction; None without one.
    """

    def __init__(self):
        self.direction = np.zeros(3)
        self.target: tuple[float, float] | None = None

    def action(self, commanded: np.ndarray, last: np.ndarray) -> np.ndarray:
        """Return the action of a cart, ``[3]`` (m, m, rad), with a gentle acceleration from the last one.

        Args:
            commanded: commanded cart pose, ``[3]`` (m, m, rad).
            last: last action, ``[3]``.
        """
        wanted = self.direction * ACTION_LIMIT
        if self.target is not None:
            way = np.asarray(self.target) - commanded[:2]
            # The speed from which the cart can still stop; near the target less, against oscillation.
            brake = np.sqrt(2 * 0.7 * ACCELERATION[:2] * np.abs(way))
            speed = np.minimum(brake, NEAR * np.abs(way)) * CONTROL_DT
            wanted[:2] = np.sign(way) * np.minimum(speed, ACTION_LIMIT[:2])
        change = ACCELERATION * CONTROL_DT**2
        return last + np.clip(wanted - last, -change, change)


class Session:
    """Episodes of a task, one after the other, one control step at a time.

    Args:
        task: name of the task.
        actor: world model and policy; without it there are no predictions and no policy drives.
        expert: expert of the task; by default the task's own, or the one that ships with the package.
        seed: number of the first scene.
        split: split of the scenes.
        delay: age of the frames that the actor gets, in control steps.

    Attributes:
        delay: see above; :meth:`set_delay` changes it.
        driver: one of ``person``, ``expert``, ``policy``.
        imagining: whether world model and policy continue without frames, on predicted latents.
        person: input of the person.
        td: present observation, ``[1]``.
        prediction: prediction of the present: ``pixels`` uint8 ``[S, cameras * S, 3]`` and ``[D]`` by quantity; empty
            in the first step of an episode, and without a world model.
        trace: true and predicted dynamics of this episode: ``(quantity, "true" | "predicted")`` to rows ``[D]``, NaN
            without a prediction.

    Raises:
        ValueError: an expert is named for a task that has one of its own.
    """

    def __init__(
        self,
        task: str,
        actor: Actor | None = None,
        expert: str | Path | None = None,
        seed: int = 0,
        split: str = "validation",
        delay: int = 0,
    ):
        self.env = DynmapBatchedEnv(task, 1, from_pixels=True)
        self.actor, self.seed, self.split = actor, seed, split
        self.task: BaseTask = self.env.task
        self.expert, self.expert_task = _find_expert(self.task, expert or task, named=expert is not None)
        self.driver, self.person = "policy" if actor else "person", Person()
        if actor:
            check_actor(actor, self.task)
        self.delay: int | None = None
        self.set_delay(delay)

    def set_delay(self, delay: int) -> None:
        """Change the age of the frames that the actor gets, 0 to 20 control steps, and begin the scene again."""
        delay = min(max(delay, 0), MAX_DELAY)
        if delay == self.delay:
            return
        self.delay = delay
        self._follower = DelayedActor(self.actor, self.delay) if self.actor and self.delay else self.actor
        self.restart(self.seed)

    @property
    def drivers(self) -> tuple[str, ...]:
        """Drivers that are available."""
        expert = self.expert is not None or self.task.has_demonstrator
        available = {"person": True, "expert": expert, "policy": self.actor is not None}
        return tuple(driver for driver in DRIVERS if available[driver])

    @property
    def world(self):
        """The simulated world."""
        return self.env.worlds[0]

    @property
    def over(self) -> bool:
        """Whether the episode's steps have passed."""
        return self.world.steps >= self.env.layout.steps

    @property
    def succeeded(self) -> bool:
        """Whether the episode would be a success if it ended now."""
        return self.task.is_success(self.world)

    def restart(self, seed: int | None = None) -> None:
        """Begin a new episode, with the next scene unless one is given."""
        self.seed = self.seed + 1 if seed is None else seed
        seeds = torch.tensor([scene_seed(self.split, self.seed)])
        self.td = self.env.reset(TensorDict({"scene_seed": seeds}, [1]))
        self.scene_seed, self.imagining = int(seeds), False
        self.demonstrate: Callable | None = None
        self.drove: set[str] = set()
        self.steps: list[TensorDict] = []
        self.trace = defaultdict(list)
        self.prediction: dict[str, np.ndarray] = {}
        self.memory = TensorDict({}, [1])  # of the actor: zero at first
        self.frames: deque[torch.Tensor] = deque(maxlen=self.delay + 1)  # the actor gets the first
        self._note()

    @torch.no_grad()
    def step(self) -> None:
        """Take one control step, or none where the episode is over."""
        if self.over:
            return
        self.drove.add(self.driver)
        if self.driver != "expert":
            self.demonstrate = None  # it plans anew when it takes over
        seen = self._act()
        actions = {
            "person": self._person_action,
            "expert": self._expert_action,
            "policy": lambda: seen["action"],
        }
        action = torch.as_tensor(np.asarray(actions[self.driver]()), dtype=torch.float32).reshape(1, -1)
        td = self.env.step(self.td.set("action", action))
        if self.actor:
            self._predict(seen.set("action", action))  # as in an evaluation: before the limits
        executed = self.world.action if isinstance(self.task, Task) else self.env.action_spec.project(action)
        td["action"] = torch.as_tensor(executed, dtype=torch.float32).reshape(1, -1)
        td["expert_action"] = td["action"]  # who drives is the one to imitate
        self.steps.append(td.select(*KEYS).clone())
        self.td = td["next"]
        self._note()

    def episode(self) -> TensorDict:
        """Return the steps so far, ``[1, T]``, with the entries of a demonstration."""
        return torch.stack(self.steps, 1)

    def _person_action(self) -> np.ndarray:
        if not isinstance(self.task, Task):
            return self.task.person_action(self.world, self.person.direction)
        return self.person.action(self.world.commanded, self.world.action)

    def _expert_action(self) -> np.ndarray:
        if self.task.has_demonstrator:
            self.demonstrate = self.demonstrate or self.task.demonstrator(self.world)
            what = f"an action of the demonstrator of {self.task.name}"
            return check_action(self.demonstrate(), len(self.env.layout.action), what)
        state = torch.from_numpy(self.expert_task.state(self.world))
        return self.world.action_for(self.expert(state)[0].numpy())

    def _act(self) -> TensorDict:
        """Return what the actor reads and writes at this step; without a frame in imagination."""
        seen = self.memory.clone()
        if self.actor:
            imagining = self.imagining and "predicted_latent" in seen
            seen.update(self.td.select("goal"))
            if not imagining:
                seen["pixels"] = self.frames[0]
            self._follower.act(self._follower.observe(seen))
        return seen

    def _predict(self, seen: TensorDict) -> None:
        self.memory = self._follower.predict(seen)["next"]
        world_model = self.actor.world_model
        states = tuple(self.memory[key] for key in ("predicted_latent", "hidden1", "hidden2"))
        frame = world_model.decode_pixels(*states)[0].clamp(0, 1) * 255
        self.prediction = {"pixels": frame.round().byte().permute(1, 2, 0).numpy()}
        values = world_model.decode_dynamics(*states)
        sizes = {quantity: len(names) for quantity, names in self.env.layout.dynamics.items()}
        # A world model of other dynamics, such as those of a track, has none that could be compared.
        self.prediction |= {q: v[0].numpy() for q, v in values.items() if v.shape[-1] == sizes[q]}

    def _note(self) -> None:
        self.frames.append(self.td["pixels"])
        for quantity in DYNAMICS:
            self.trace[quantity, "true"].append(self.td["dynamics", quantity][0].numpy())
            nothing = np.full(len(self.env.layout.dynamics[quantity]), np.nan)
            self.trace[quantity, "predicted"].append(self.prediction.get(quantity, nothing))


def _find_expert(task: BaseTask, name: str | Path, named: bool):
    """Return an expert and the task whose state it reads; None twice where none is named and none ships."""
    if task.has_demonstrator:
        if named:
            raise ValueError(f"--expert has no effect with {task.name}, which has an expert of its own")
        return None, None
    try:
        expert = load_expert(name)
    except ValueError:
        if named:
            raise
        return None, None
    return expert, task_of_expert(name, task)
