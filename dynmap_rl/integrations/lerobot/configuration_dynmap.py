"""Settings of the policy ``dynmap``; LeRobot derives the names of the other two modules from this one's."""

from __future__ import annotations

from dataclasses import dataclass, field

from lerobot.configs import NormalizationMode, PreTrainedConfig
from lerobot.optim import AdamWConfig
from lerobot.optim.schedulers import CosineAnnealingWithWarmupSchedulerConfig

from dynmap_rl.keys import DYNAMICS, FRAME_SHAPE
from dynmap_rl.modules.checkpoints import check_policy
from dynmap_rl.modules.supervision import parse_supervision
from dynmap_rl.modules.world_model import ARCHITECTURES
from dynmap_rl.utils.settings import check_at_least

GOAL = 2  # entries of the goal, x and y


@PreTrainedConfig.register_subclass("dynmap")
@dataclass
class DynmapConfig(PreTrainedConfig):
    """Settings of ``--policy.type=dynmap``: world model and policy, trained jointly (paper, Eq. 4 and 5).

    Weights, sizes and learning rate are those of ``recipes/joint.py``, with LeRobot's batch size of 8.

    Attributes:
        supervision: dynamics that the world model predicts: any of ``position,velocity,acceleration``, or ``none``
            (Only-RGB). The dataset needs the columns ``dynamics.*``.
        kind: ``recurrent`` or ``feedforward`` policy.
        latent_size: Z of the world model.
        hidden_size: H of the world model.
        architecture: ``glimpse``, ``plain``, ``resnet18``, ``resnet18_imagenet`` or ``vit`` (see
            :class:`dynmap_rl.modules.WorldModel`).
        width: width of the policy; 0 for its default.
        window_steps: steps of a training window.
        rgb_frames: decoded frames of a batch.
        rarity: weight of rare colours in the RGB loss.
        beta_z: weight of the latent loss.
        beta_dynamics: weight of the loss of every supervised quantity.
        beta_joint: weight of the policy's loss.
        emphasis: see :func:`dynmap_rl.objectives.imitation_loss`.
        recolor: permute the colour channels of training windows.
        symmetric: mirror and shift training windows. By default, true where the dataset's task is symmetric.
        mixed: train, and encode frames in control, in bfloat16 where the processor supports it.
        delay: age of a frame, in control steps, when the action that it leads to is executed. In ``select_action``, every
            frame is this old. In ``predict_action_chunk``, it is the time from a frame to the arrival of its chunk.
        chunk_size: actions that ``predict_action_chunk`` returns.
        optimizer_lr: learning rate of AdamW.
        optimizer_weight_decay: weight decay of AdamW.
        sizes: numbers of entries of action, goal and dynamics; written by training.
        task: task of the dataset; written by training.
        source: origin of the world model (see :func:`dynmap_rl.runs.load_world_model_of`); written by training.

    Raises:
        ValueError: supervision or kind is unknown, windows have less than two steps, ``delay`` is not below
            ``chunk_size``, or ``beta_dynamics`` has no effect.
    """

    supervision: str = "position,velocity"
    kind: str = "recurrent"
    latent_size: int = 64
    hidden_size: int = 128
    architecture: str = "glimpse"
    width: int = 0
    window_steps: int = 48
    rgb_frames: int = 128
    rarity: float = 0.75
    beta_z: float = 0.1
    beta_dynamics: float = 1.0
    beta_joint: float = 1.0
    emphasis: float = 60.0
    recolor: bool = True
    symmetric: bool | None = None
    mixed: bool = True
    delay: int = 0
    chunk_size: int = 20
    optimizer_lr: float = 2e-3
    optimizer_weight_decay: float = 1e-4
    sizes: dict[str, int] = field(
        default_factory=lambda: {"action": 3, "goal": GOAL, **dict.fromkeys(DYNAMICS, 6)}
    )
    task: str | None = None
    source: dict[str, str] | None = None
    # The modules hold constants of their own, which are saved with the weights.
    normalization_mapping: dict[str, NormalizationMode] = field(
        default_factory=lambda: dict.fromkeys(("VISUAL", "STATE", "ACTION"), NormalizationMode.IDENTITY)
    )

    def __post_init__(self):
        super().__post_init__()
        supervision = parse_supervision(self.supervision)
        check_policy(self.kind)
        if self.architecture not in ARCHITECTURES:
            raise ValueError(
                f"--policy.architecture must be one of {', '.join(ARCHITECTURES)}, got {self.architecture!r}"
            )
        check_at_least(self, 2, "window_steps")
        check_at_least(self, 1, "latent_size", "hidden_size", "rgb_frames")
        check_at_least(self, 0, "width", "beta_z", "beta_dynamics", "beta_joint", "emphasis", "rarity")
        check_at_least(self, 0, "optimizer_lr", "optimizer_weight_decay")
        if not supervision and self.beta_dynamics != 1.0:
            raise ValueError("--policy.beta_dynamics has no effect with supervision none; leave it out")
        if not 0 <= self.delay < self.chunk_size:
            raise ValueError(
                f"--policy.delay must be at least 0 and below --policy.chunk_size, got {self.delay} and {self.chunk_size}"
            )

    @property
    def camera(self) -> str:
        """Column of the frames."""
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
        """Number of steps at the end of an episode from which no window begins."""
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
        """Check for one camera of 64 x 64 pixels, a state that ends with the goal x, y, and an action.

        Raises:
            ValueError: a feature is missing or has another shape.
        """
        frame = FRAME_SHAPE[2], *FRAME_SHAPE[:2]
        shapes = [tuple(feature.shape) for feature in self.image_features.values()]
        if shapes != [frame]:
            raise ValueError(f"dynmap needs one camera of {frame}, got {shapes or 'none'}")
        if self.robot_state_feature is None or self.robot_state_feature.shape[0] < 2:
            raise ValueError("dynmap needs observation.state, whose last two entries are the goal x, y (m)")
        if self.action_feature is None:
            raise ValueError("dynmap needs the feature action")
