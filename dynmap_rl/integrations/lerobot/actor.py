"""Policies of LeRobot, such as ACT and Diffusion, as TensorDict modules."""

from __future__ import annotations

from pathlib import Path

import torch
from draccus.utils import DraccusException
from lerobot.configs import PreTrainedConfig
from lerobot.policies.factory import get_policy_class, make_pre_post_processors
from lerobot.utils.constants import OBS_IMAGES, OBS_STATE
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase

from dynmap_rl.envs.protocol import BaseTask
from dynmap_rl.utils.hub import first_line


class LeRobotActor(TensorDictModuleBase):
    """Trained LeRobot policy as a TensorDict policy, one time step a call.

    It reads ``pixels`` ``[B, 3, S, cameras * S]`` and ``agent_pos`` and writes ``action`` ``[B, A]``, with the sizes of the
    task's layout (see :class:`dynmap_rl.envs.Layout`). Its memory (chunks of actions, past observations) belongs to one
    batch of episodes, which all begin at the same time: call :meth:`reset` before the first step of the next batch.

    Args:
        path: ``pretrained_model`` folder of ``lerobot-train``, or the id of a policy on the Hugging Face hub.
        device: device to run on.
        task: task of the frames, whose cameras are found by their names; the picture of a flat task may have any name. Its
            ``description`` is the text for policies that read one. Without a task, the cameras are those of the policy, in
            its order, and the text is empty.
        cut: on late frames, execute a chunk from its action for the present step, by the entry ``delay`` ``[B, 1]``,
            rather than from its first action. Needs a policy that predicts chunks from one observation, such as ACT.
            ``agent_pos`` is that of the present, and a chunk that is shorter than delay and ``n_action_steps`` together
            ends with repetitions of its last action.

    Raises:
        ValueError: the folder or id holds no LeRobot policy, or the policy does not fit ``task``, or ``cut`` is given and
            the policy predicts from several observations.

    Calling it raises ``ValueError`` where the frames are those of another number of cameras.
    """

    out_keys = ["action"]

    def __init__(
        self,
        path: str | Path,
        device: torch.device | str = "cpu",
        task: BaseTask | None = None,
        cut: bool = False,
    ):
        super().__init__()
        self.in_keys = ["pixels", "agent_pos", *(["delay"] if cut else [])]
        self.instruction, self.cut, self.cameras = task.description if task else "", cut, None
        try:
            config = PreTrainedConfig.from_pretrained(str(path))
            config.device = str(device)
            self.policy = get_policy_class(config.type).from_pretrained(str(path), config=config).eval()
            self.processors = make_pre_post_processors(
                config, str(path), preprocessor_overrides={"device_processor": {"device": str(device)}}
            )
        except (OSError, KeyError, ValueError, ImportError, DraccusException) as error:
            reason = first_line(error)
            raise ValueError(
                f"{path} must be a policy of LeRobot, but it cannot be loaded ({reason}); name the folder "
                "pretrained_model of a checkpoint, or the id of a policy"
            ) from error
        if cut and config.n_obs_steps != 1:
            raise ValueError(
                f"cut must be False for the policy type {config.type}, which predicts from {config.n_obs_steps} observations"
            )
        if cut and not hasattr(config, "n_action_steps"):
            raise ValueError(
                f"cut must be False for the policy type {config.type}, which has no chunks to cut; turn a policy dynmap into "
                "a run with import_from_lerobot"
            )
        if task:
            check_config(config, task)
            if not task.planar:
                self.cameras = [f"{OBS_IMAGES}.{camera}" for camera in task.layout.cameras]
        self.reset()

    def reset(self) -> None:
        """Clear the memory, as all episodes of the batch begin."""
        self.policy.reset()
        self._chunk, self._next = None, 0

    @torch.no_grad()
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the action of this step."""
        before, after = self.processors
        frames = tensordict["pixels"].float() / 255
        frames = frames.split(frames.shape[-2], -1)
        names = list(self.policy.config.image_features)
        cameras = self.cameras or names
        if len(cameras) != len(frames):
            raise ValueError(
                f"the policy must read {len(frames)} cameras, but it reads {', '.join(cameras) or 'none'}"
            )
        pictures = dict(zip(cameras, frames, strict=True))
        observation = {name: pictures[name] for name in names} | {OBS_STATE: tensordict["agent_pos"]}
        batch = before({**observation, "task": [self.instruction] * len(tensordict)})
        action = self._cut(batch, tensordict["delay"]) if self.cut else self.policy.select_action(batch)
        return tensordict.set("action", after(action).to(tensordict["agent_pos"]))

    def _cut(self, batch: dict, delay: torch.Tensor) -> torch.Tensor:
        """Return the next action of the chunk; of a new chunk, that for the present step."""
        if self._chunk is None or self._next == self.policy.config.n_action_steps:
            self._chunk, self._next = self.policy.predict_action_chunk(batch), 0
            self._first = delay.to(self._chunk.device)
        last = self._chunk.shape[1] - 1  # where a chunk is shorter than the delay, its last action
        place = (self._first + self._next).clamp(max=last)[..., None].expand(-1, -1, self._chunk.shape[2])
        self._next += 1
        return self._chunk.gather(1, place)[:, 0]


def check_config(config: PreTrainedConfig, task: BaseTask) -> None:
    """Raise ``ValueError`` where a policy reads other cameras, or has other sizes, than the layout of a task."""
    layout, wrong = task.layout, []
    names = [name.removeprefix(f"{OBS_IMAGES}.") for name in config.image_features]
    if not names or (len(names) > 1 if task.planar else set(names) - set(layout.cameras)):
        found, expected = (", ".join(some) or "none" for some in (names, layout.cameras))
        wrong.append(f"the cameras {found} instead of {expected}")
    size = 2 * [layout.image_size]
    wrong += [
        f"{name} of {list(feature.shape[-2:])} pixels instead of {size}"
        for name, feature in config.image_features.items()
        if list(feature.shape[-2:]) != size
    ]
    sizes = {
        "state": (config.robot_state_feature, layout.state),
        "action": (config.action_feature, layout.action),
    }
    for name, (feature, entries) in sizes.items():
        if feature and tuple(feature.shape) != (len(entries),):
            wrong.append(f"{name} {list(feature.shape)} instead of {[len(entries)]}")
    if wrong:
        raise ValueError(
            f"the policy must fit {task.name}, but it has {', '.join(wrong)}; choose the task that it was trained on, "
            "with its cameras, as in mujoco:PlateSlide:cameras=2"
        )
