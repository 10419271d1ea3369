"""World model and policy as the LeRobot policy ``dynmap``: joint training on windows, recurrent control."""

from __future__ import annotations

from contextlib import nullcontext
from pathlib import Path

import torch
from lerobot.policies import PreTrainedPolicy
from lerobot.utils.constants import ACTION, OBS_STATE
from tensordict import TensorDict

from dynmap_rl.data.augmentation import augment
from dynmap_rl.data.demonstrations import find_meta
from dynmap_rl.data.normalization import normalization_constants
from dynmap_rl.data.settings import Augmentation
from dynmap_rl.envs.world import ACTION_LIMIT
from dynmap_rl.keys import DYNAMICS
from dynmap_rl.modules.actor import Actor
from dynmap_rl.modules.backbones import load_imagenet
from dynmap_rl.modules.checkpoints import make_policy, make_world_model
from dynmap_rl.modules.chunk_actor import ChunkActor
from dynmap_rl.modules.delayed_actor import DelayedActor
from dynmap_rl.modules.precision import mixed_precision
from dynmap_rl.modules.supervision import parse_supervision
from dynmap_rl.objectives.joint import JointLoss
from dynmap_rl.objectives.world_model import WorldModelLoss
from dynmap_rl.utils.hub import first_line

from .columns import is_symmetric, read_columns
from .configuration_dynmap import GOAL, DynmapConfig

OPTIONAL = "expert_action", "labelled"  # columns that a dataset may lack


class DynmapPolicy(PreTrainedPolicy):
    """World model, and the policy that acts on its states.

    Args:
        config: settings.
        dataset_stats: LeRobot's statistics; not used.
        dataset_meta: metadata of the dataset to train on. It provides the constants of normalisation, which are saved
            with the weights, and the targets ``dynamics.*``, which LeRobot does not put into a batch.

    Raises:
        ValueError: features or columns do not fit.
    """

    config_class = DynmapConfig
    name = "dynmap"

    def __init__(self, config: DynmapConfig, dataset_stats=None, dataset_meta=None):
        super().__init__(config)
        config.validate_features()
        self.config = config
        # Where there is no dataset, weights from a checkpoint overwrite these.
        constants = {name: {"low": [-1.0] * n, "high": [1.0] * n} for name, n in config.sizes.items()}
        self.trainable, self.symmetric = dataset_meta is not None, bool(config.symmetric)
        if dataset_meta is not None:
            columns, meta = read_columns(dataset_meta.root), find_meta(Path(dataset_meta.root))
            if meta is None and columns["action"].shape[-1] != len(ACTION_LIMIT):
                raise ValueError(
                    f"{dataset_meta.root} must be a recording, with an action of {len(ACTION_LIMIT)} entries, got "
                    f"{columns['action'].shape[-1]}; train on robot datasets with recipes/robot.py"
                )
            # A recording that LeRobot's tools have edited has no metadata.
            constants = meta["normalization"] if meta else normalization_constants(columns[None])
            config.sizes = {name: len(constants[name]["low"]) for name in config.sizes}
            if config.sizes["goal"] != GOAL:
                raise ValueError(
                    f"{dataset_meta.root} must have a goal of {GOAL} entries (x, y), got {config.sizes['goal']}"
                )
            task = meta["task"] if meta else None
            if config.symmetric is None:
                self.symmetric = is_symmetric(task)
            config.task = task or config.task
            config.source = {"task": config.task, "training": "joint"} if config.task else None
            # Buffers, to be on the model's device, but no part of a checkpoint.
            for name in ("index", "step_count", "disturbed", *OPTIONAL):
                self.register_buffer(name, columns.get(name, None), persistent=False)
            for name in DYNAMICS:
                self.register_buffer(name, columns["dynamics", name], persistent=False)
        sizes = config.latent_size, config.hidden_size, config.architecture
        self.world_model = make_world_model(constants, parse_supervision(config.supervision), *sizes)
        begins = dataset_meta is not None and not config.pretrained_path
        if begins and config.architecture == "resnet18_imagenet":
            load_imagenet(self.world_model.encoder)
        width = {"width": config.width} if config.width else {}
        self.policy = make_policy(constants, config.kind, self.world_model, **width)
        self.reset()

    @classmethod
    def _load_as_safetensor(cls, model, model_file, map_location, strict):
        """Load all weights, or raise ``ValueError``; LeRobot's default would leave random ones where some are missing."""
        try:
            return super()._load_as_safetensor(model, model_file, map_location, strict=True)
        except RuntimeError as error:
            raise ValueError(
                f"{model_file} has weights of another architecture ({first_line(error)}); leave out options such as "
                "--policy.kind and --policy.supervision, which are those of the checkpoint"
            ) from error

    def get_optim_params(self):
        """Return the parameters to optimise."""
        return self.parameters()

    def reset(self) -> None:
        """Clear the memory, as an episode begins in every environment of the batch."""
        self._memory: TensorDict | None = None
        # Neither is a registered submodule, as the weights would be saved a second time.
        actor = Actor(self.world_model, self.policy, mixed=self.config.mixed)
        self._chunks = ChunkActor(actor, self.config.chunk_size, self.config.delay)

    def forward(self, batch: dict[str, torch.Tensor]) -> tuple[torch.Tensor, dict[str, float]]:
        """Return the joint loss on windows ``[B, T]`` from LeRobot's loader, and its terms by name."""
        windows = self.make_windows(batch)
        if self.training:
            windows = self._augment(windows)
        config = self.config
        world_model_loss = WorldModelLoss(
            self.world_model,
            config.beta_z,
            config.beta_dynamics,
            rarity=config.rarity,
            rgb_frames=config.rgb_frames,
        )
        # As an attribute, the loss module would save all weights a second time.
        loss_module = JointLoss(world_model_loss, self.policy, config.beta_joint, config.emphasis)
        with mixed_precision(windows.device) if config.mixed else nullcontext():
            losses = loss_module(windows)
        return sum(losses.values()), {name: value.item() for name, value in losses.items()}

    def make_windows(self, batch: dict[str, torch.Tensor]) -> TensorDict:
        """Convert a batch of LeRobot's loader to the input of the losses.

        Returns:
            ``[B, T]`` with ``pixels``, ``action``, ``goal``, ``dynamics``, ``disturbed``, ``step_count``, where the
            dataset has them ``expert_action`` and ``labelled``, and a mask that is false beyond the end of an episode.

        Raises:
            ValueError: the policy was made without a dataset.
        """
        if not self.trainable:
            raise ValueError(
                "the policy must be made with dataset_meta to be trained, since dynamics are read from the dataset"
            )
        action, beyond = batch[ACTION], batch["action_is_pad"]
        steps = torch.arange(action.shape[1], device=action.device)
        last = (~beyond).sum(1, keepdim=True) - 1
        index = batch["index"].view(-1, 1) + torch.minimum(steps, last)  # (B, T), within the episode
        rows = torch.searchsorted(self.index, index)  # the dataset may be a part
        data = {
            "pixels": to_bytes(batch[self.config.camera]),
            "action": action,
            "goal": batch[OBS_STATE][..., -GOAL:],
            "dynamics": {name: getattr(self, name)[rows] for name in DYNAMICS},
            "disturbed": self.disturbed[rows],
            "step_count": self.step_count[rows],
            ("collector", "mask"): ~beyond,
        }
        data |= {name: getattr(self, name)[rows] for name in OPTIONAL if getattr(self, name) is not None}
        return TensorDict(data, action.shape[:2], device=action.device)

    def _augment(self, windows: TensorDict) -> TensorDict:
        # Seeded by torch's own generator, which LeRobot saves and restores.
        generator = torch.Generator(windows.device).manual_seed(torch.randint(2**62, ()).item())
        moved = {} if self.symmetric else {"max_shift": 0, "mirror": False}
        return augment(windows, generator, Augmentation(recolor=self.config.recolor, **moved))

    @torch.no_grad()
    def select_action(self, batch: dict[str, torch.Tensor], **kwargs) -> torch.Tensor:
        """Return the action ``[B, 3]`` (m, m, rad) of this step.

        Args:
            batch: frames ``[B, 3, 64, 64]``, ``delay`` steps old, or the first of the episode; states ``[B, 5]``.
            kwargs: not used.
        """
        self.eval()
        pixels = to_bytes(batch[self.config.camera])
        td = TensorDict({}, [len(pixels)]) if self._memory is None else self._memory
        td = td.set("pixels", pixels).set("goal", batch[OBS_STATE][:, -GOAL:])
        td = DelayedActor(self._chunks.actor, self.config.delay)(td)
        self._memory = td["next"]
        return td["action"]

    def predict_action_chunk(self, batch: dict[str, torch.Tensor], **kwargs) -> torch.Tensor:
        """Return the actions ``[B, chunk_size, 3]`` of the step of a frame and of the steps after it, by imagination.

        Args:
            batch: frames ``[B, 3, 64, 64]``; states ``[B, 5]`` or, with the number of the step in front, ``[B, 6]``.
                Without this number, the whole last chunk has been executed since the last frame.
            kwargs: not used.

        Raises:
            ValueError: the numbers of the steps differ.
        """
        self.eval()
        state = batch[OBS_STATE]
        numbered = state.shape[-1] > self.config.robot_state_feature.shape[0]
        if numbered and (state[:, 0] != state[0, 0]).any():
            raise ValueError(f"frames of a batch must be of one step, got steps {state[:, 0].tolist()}")
        step = int(state[0, 0]) if numbered else None
        return self._chunks.act(to_bytes(batch[self.config.camera]), state[:, -GOAL:], step)


def to_bytes(pixels: torch.Tensor) -> torch.Tensor:
    """Convert LeRobot's frames in 0..1 back to uint8."""
    return pixels if pixels.dtype == torch.uint8 else (pixels * 255).round().to(torch.uint8)
