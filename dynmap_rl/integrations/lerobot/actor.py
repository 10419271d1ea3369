"""Policies of LeRobot as TensorDict modules: ACT, Diffusion and the like in our environments and evaluation."""

from __future__ import annotations

from pathlib import Path

import torch
from lerobot.configs import PreTrainedConfig
from lerobot.policies.factory import get_policy_class, make_pre_post_processors
from lerobot.utils.constants import OBS_STATE
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase

from dynmap_rl.data.demonstrations import CAMERA
from dynmap_rl.utils.hub import first_line


class LeRobotActor(TensorDictModuleBase):
    """A trained policy of LeRobot as an actor: reads ``pixels`` ``[B, 3, 64, 64]`` and ``agent_pos`` ``[B, 5]``, writes
    ``action`` ``[B, 3]`` (m, m, rad), one time step a call.

    Its memory (chunks of actions, past observations) is that of one batch of episodes, which all begin at the same time:
    call :meth:`reset` before the first step of the next ones.

    Args:
        path: a ``pretrained_model`` folder of ``lerobot-train``, or the id of a policy on the Hugging Face hub.
        device: to run on.
        instruction: for policies that read one; our datasets have the task's ``description``.

    Raises:
        ValueError: there is no such policy.
    """

    in_keys = ["pixels", "agent_pos"]
    out_keys = ["action"]

    def __init__(self, path: str | Path, device: torch.device | str = "cpu", instruction: str = ""):
        super().__init__()
        self.instruction = instruction
        try:
            config = PreTrainedConfig.from_pretrained(str(path))
            config.device = str(device)
            self.policy = get_policy_class(config.type).from_pretrained(str(path), config=config).eval()
            self.processors = make_pre_post_processors(
                config, str(path), preprocessor_overrides={"device_processor": {"device": str(device)}}
            )
        except (OSError, KeyError, ValueError, ImportError) as error:
            reason = first_line(error)
            raise ValueError(f"{path} holds no policy of LeRobot ({reason})") from error
        self.reset()

    def reset(self) -> None:
        """All episodes of the batch begin."""
        self.policy.reset()

    @torch.no_grad()
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        before, after = self.processors
        observation = {CAMERA: tensordict["pixels"].float() / 255, OBS_STATE: tensordict["agent_pos"]}
        action = self.policy.select_action(
            before({**observation, "task": [self.instruction] * len(tensordict)})
        )
        return tensordict.set("action", after(action).to(tensordict["agent_pos"]))
