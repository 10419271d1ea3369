"""Settings of the policy ``dynmap``; LeRobot finds the other two files of the three by this one's name."""

from __future__ import annotations

from dataclasses import dataclass, field

from lerobot.configs import NormalizationMode, PreTrainedConfig
from lerobot.optim import AdamWConfig
from lerobot.optim.schedulers import CosineAnnealingWithWarmupSchedulerConfig

from dynmap_rl.data.demonstrations import FRAME_SHAPE
from dynmap_rl.modules.checkpoints import check_policy
from dynmap_rl.modules.supervision import parse_supervision


@PreTrainedConfig.register_subclass("dynmap")
@dataclass
class DynmapConfig(PreTrainedConfig):
    """``--policy.type=dynmap``: a world model and a policy, trained jointly (paper, Eq. 4 and 5).

    Defaults are those of ``recipes/joint.py``, whose batches have as many windows as LeRobot's (8).

    Args:
        supervision: which dynamics the world model is supervised on: any of ``position,velocity,acceleration``, or
            ``none`` (Only-RGB). The dataset needs the columns ``dynamics.*``.
        kind: of the policy: ``recurrent`` or ``feedforward``.
        latent_size, hidden_size, keypoints: of the world model.
        width: of the policy; 0 for its default.
        window_steps: steps of a training window, which lies within one episode.
        rgb_steps: decoded frames of a window.
        beta_z, beta_dynamics, beta_joint, emphasis: of the losses (see ``dynmap_rl.objectives``).
        recolor: permute the colour channels of training windows, and paint up to ``distractors`` bars on each.
        symmetric: mirror and shift training windows too, which is right where the task has no places of its own. By
            default what the task is that the dataset tells, and false where it tells none.
        mixed: train, and encode frames in control, in bfloat16 where the processor computes with it.
        optimizer_lr, optimizer_weight_decay: of AdamW.
        task: that the policy was trained on; written by training where the dataset tells it.
        source: where its world model is from (see :func:`dynmap_rl.frozen.load_source`); written by training too.

    Raises:
        ValueError: an unknown supervision or kind, or windows of less than two steps.
    """

    supervision: str = "position,velocity"
    kind: str = "recurrent"
    latent_size: int = 64
    hidden_size: int = 128
    keypoints: bool = False
    width: int = 0
    window_steps: int = 48
    rgb_steps: int = 16
    beta_z: float = 0.1
    beta_dynamics: float = 1.0
    beta_joint: float = 1.0
    emphasis: float = 60.0
    recolor: bool = True
    distractors: int = 3
    symmetric: bool | None = None
    mixed: bool = True
    optimizer_lr: float = 2e-3
    optimizer_weight_decay: float = 1e-4
    task: str | None = None
    source: dict[str, str] | None = None
    # None, for the modules hold constants of their own, in weights that are saved with the rest.
    normalization_mapping: dict[str, NormalizationMode] = field(
        default_factory=lambda: dict.fromkeys(("VISUAL", "STATE", "ACTION"), NormalizationMode.IDENTITY)
    )

    def __post_init__(self):
        super().__post_init__()
        parse_supervision(self.supervision)
        check_policy(self.kind)
        if self.window_steps < 2:
            raise ValueError(f"--policy.window_steps must be at least 2, not {self.window_steps}")

    @property
    def camera(self) -> str:
        """The column of the frames."""
        return next(iter(self.image_features))

    @property
    def observation_delta_indices(self) -> list[int]:
        return list(range(self.window_steps))

    @property
    def action_delta_indices(self) -> list[int]:
        return list(range(self.window_steps))

    @property
    def reward_delta_indices(self) -> None:
        return None

    @property
    def drop_n_last_frames(self) -> int:
        """No window begins where it would reach beyond the end of the episode."""
        return self.window_steps - 1

    def get_optimizer_preset(self) -> AdamWConfig:
        return AdamWConfig(
            lr=self.optimizer_lr,
            betas=(0.9, 0.99),
            weight_decay=self.optimizer_weight_decay,
            grad_clip_norm=1.0,
        )

    def get_scheduler_preset(self) -> CosineAnnealingWithWarmupSchedulerConfig:
        return CosineAnnealingWithWarmupSchedulerConfig(num_warmup_steps=100)

    def validate_features(self) -> None:
        """Raises ``ValueError`` for anything but one camera of 64 x 64 pixels, a state that ends with the goal x, y,
        and an action."""
        frame = FRAME_SHAPE[2], *FRAME_SHAPE[:2]
        shapes = [tuple(feature.shape) for feature in self.image_features.values()]
        if shapes != [frame]:
            raise ValueError(f"dynmap sees one camera of {frame}, not {shapes or 'none'}")
        if self.robot_state_feature is None or self.robot_state_feature.shape[0] < 2:
            raise ValueError("dynmap needs observation.state, whose last two entries are the goal x, y (m)")
        if self.action_feature is None:
            raise ValueError("dynmap needs the feature action")
