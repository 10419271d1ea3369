"""Typed settings of every training. A comment above a field is the help text of its option."""

from __future__ import annotations

from dataclasses import dataclass

from dynmap_rl.data.settings import Augmentation
from dynmap_rl.keys import DYNAMICS
from dynmap_rl.utils.settings import check_at_least, check_choice, check_share

SHORT = 4  # steps of a short window


@dataclass(frozen=True)
class WorldModelArchitecture:
    """Form of a world model."""

    # Dynamics that the world model predicts: any of position,velocity,acceleration, or none (Only-RGB).
    supervision: str = "position,velocity"
    # glimpse (attention maps find places, where the encoder reads crops and the decoder draws small images), plain
    # (CNNs), or glimpse with an encoder of torchvision: resnet18, resnet18_imagenet (begins with weights that torchvision
    # downloads) or vit.
    architecture: str = "glimpse"

    def __post_init__(self):
        check_choice(self, "architecture", ("glimpse", "plain", "resnet18", "resnet18_imagenet", "vit"))
        names = [name.strip() for name in self.supervision.split(",")]
        ordered = ",".join(name for name in DYNAMICS if name in names)  # one name for each set
        if names != ["none"] and (len(set(names)) < len(names) or not set(names) <= set(DYNAMICS)):
            raise ValueError(
                f"{type(self).__name__}.supervision must be any of {', '.join(DYNAMICS)} with commas between, or "
                f"none, got {self.supervision!r}"
            )
        object.__setattr__(self, "supervision", ordered or "none")


@dataclass(frozen=True)
class WorldModelTraining(WorldModelArchitecture):
    """Form and training of a world model (paper, Eq. 4a and 5)."""

    # Updates of the weights.
    updates: int = 900
    # Windows in a batch.
    windows: int = 12
    # Time steps of a window.
    window_steps: int = 24
    # Share of the updates, from the start, that have windows of 4 steps, with as many frames in a batch: appearance is
    # learned first, from many scenes, and memory afterwards.
    short_windows: float = 0.4
    # Share of the windows in which no frames are seen after a random step: the world model learns to predict from its own
    # predictions.
    imagined: float = 0.5
    # Frames of a batch that are decoded, drawn at random.
    rgb_frames: int = 72
    # Peak learning rate (100 updates of warm-up, then a cosine).
    learning_rate: float = 2e-3
    # Weight of rare colours in the RGB loss: a pixel's weight falls with this power of the number of pixels of its
    # colour; 0 is the paper's plain L2.
    rarity: float = 0.75
    # Weight of the RGB loss (Eq. 4a); with 0, no frames are decoded, and the dynamics alone shape the states.
    beta_rgb: float = 1.0
    # Weight of the latent loss (Eq. 4a).
    beta_z: float = 0.1
    # Weight of the loss of every supervised quantity (Eq. 5).
    beta_dynamics: float = 1.0
    # Share of the training episodes whose dynamics are used; those of the others are left out of the loss. Which
    # episodes follows from the seed, and smaller shares are parts of larger ones.
    labelled: float = 1.0
    # Seed of weights and windows.
    seed: int = 0
    # Random changes of the windows.
    augmentation: Augmentation = Augmentation()

    def __post_init__(self):
        super().__post_init__()
        check_at_least(self, 1, "updates", "windows", "rgb_frames")
        check_at_least(self, 2, "window_steps")
        check_at_least(self, 0, "seed", "learning_rate", "rarity", "beta_rgb", "beta_z", "beta_dynamics")
        check_share(self, "short_windows", "imagined", "labelled")
        if not self.labelled:
            raise ValueError(
                f"{type(self).__name__}.labelled must be above 0, got 0; supervision none uses no dynamics"
            )
        for name, idle, why in (
            ("labelled", self.supervision == "none", "supervision none"),
            ("beta_dynamics", self.supervision == "none", "supervision none"),
            ("rarity", not self.beta_rgb, "beta_rgb 0"),
            ("rgb_frames", not self.beta_rgb, "beta_rgb 0"),
        ):
            if idle and getattr(self, name) != getattr(type(self), name):
                raise ValueError(f"{type(self).__name__}.{name} has no effect with {why}; leave it out")
        if not self.beta_rgb and self.supervision == "none":
            raise ValueError(
                f"{type(self).__name__}.beta_rgb must be above 0 without supervision, got 0; nothing would be learned"
            )


@dataclass(frozen=True)
class PolicyArchitecture:
    """Form of a policy."""

    # feedforward (paper, Eq. 1) or recurrent (Eq. 2).
    kind: str = "recurrent"

    def __post_init__(self):
        check_choice(self, "kind", ("feedforward", "recurrent"))


@dataclass(frozen=True)
class PolicyTraining(PolicyArchitecture):
    """Form and training of a policy on the states of a frozen world model."""

    # Updates of the weights.
    updates: int = 1200
    # Episodes in a batch.
    batch: int = 16
    # Peak learning rate (100 updates of warm-up, then a cosine).
    learning_rate: float = 3e-3
    # Extra weight of steps in which the expert changes its action (see imitation_loss); 0 is the paper's plain L1.
    emphasis: float = 60.0
    # Augmented copies of every demonstration, whose states join its own (see Augmentation; mirroring and shifting need a
    # symmetric task).
    copies: int = 0
    # Scenes of training in which the trained policy acts and the task's expert says what it would have done (DAgger).
    # Their states join the demonstrations', and training goes on.
    corrections: int = 0
    # Updates of the weights with the corrections.
    correction_updates: int = 800

    def __post_init__(self):
        super().__post_init__()
        check_at_least(self, 1, "updates", "batch", "correction_updates")
        check_at_least(self, 0, "learning_rate", "emphasis", "copies", "corrections")


@dataclass(frozen=True)
class EndToEndTraining:
    """Training of world model and policy by the policy's loss alone (paper, Eq. 3)."""

    # Updates of the weights.
    updates: int = 2500
    # Windows in a batch.
    windows: int = 8
    # Time steps of a window.
    window_steps: int = 48
    # Share of the updates, at first, whose batches have the same number of frames in windows of 4 steps (see
    # WorldModelTraining).
    short_windows: float = 0.4
    # Peak learning rate (100 updates of warm-up, then a cosine).
    learning_rate: float = 2e-3
    # Extra weight of steps in which the expert changes its action (see imitation_loss); 0 is the paper's plain L1.
    emphasis: float = 60.0
    # Random changes of the windows; mirroring and shifting need a symmetric task.
    augmentation: Augmentation = Augmentation()

    def __post_init__(self):
        check_at_least(self, 1, "updates", "windows")
        check_at_least(self, 2, "window_steps")
        check_at_least(self, 0, "learning_rate", "emphasis")
        check_share(self, "short_windows")


@dataclass(frozen=True)
class JointTraining(EndToEndTraining):
    """Training of world model and policy with one loss (paper, Eq. 4 and 5)."""

    # Frames of a batch that are decoded, drawn at random.
    rgb_frames: int = 128
    # Weight of rare colours in the RGB loss: a pixel's weight falls with this power of the number of pixels of its
    # colour; 0 is the paper's plain L2.
    rarity: float = 0.75
    # Weight of the latent loss (Eq. 4a).
    beta_z: float = 0.1
    # Weight of the loss of every supervised quantity (Eq. 5).
    beta_dynamics: float = 1.0
    # Weight of the policy's loss (Eq. 4).
    beta_joint: float = 1.0

    def __post_init__(self):
        super().__post_init__()
        check_at_least(self, 1, "rgb_frames")
        check_at_least(self, 0, "rarity", "beta_z", "beta_dynamics", "beta_joint")


def check_window_steps(settings: WorldModelTraining | EndToEndTraining, steps: int, group: str) -> None:
    """Raise ``ValueError`` where windows are longer than episodes of ``steps`` steps; ``group`` is that of the option."""
    if settings.window_steps > steps:
        raise ValueError(
            f"--{group}.window_steps must be at most {steps}, the steps of an episode, got {settings.window_steps}"
        )


def windows_at(settings: WorldModelTraining | EndToEndTraining, update: int) -> tuple[int, int]:
    """Return number and steps of the windows of an update: at first many short ones, then the settings' own."""
    if update < settings.short_windows * settings.updates and settings.window_steps > SHORT:
        return max(1, settings.windows * settings.window_steps // SHORT), SHORT
    return settings.windows, settings.window_steps


@dataclass(frozen=True)
class PPOTraining:
    """Training of a stochastic policy by PPO (paper, Sec. IV-C)."""

    # Seed of everything random.
    seed: int = 0
    # Worlds stepped together, each from a new scene in every iteration. Many scenes matter more than long episodes.
    num_envs: int = 192
    # Steps of an iteration in every world.
    steps: int = 40
    # Iterations: rollouts and the updates from them.
    iterations: int = 60
    # Passes over the transitions of an iteration.
    epochs: int = 8
    # Transitions in a minibatch.
    minibatch: int = 1024
    # Initial learning rate, which falls to a tenth.
    learning_rate: float = 5e-4
    # Discount factor of a step.
    gamma: float = 0.97
    # Lambda of the generalised advantage estimates.
    gae_lambda: float = 0.95
    # Limit of the probability ratio.
    clip: float = 0.2
    # Weight of the entropy.
    entropy: float = 1e-3
    # Iterations between checkpoints.
    checkpoint_every: int = 10
    # Scenes on which a checkpoint is judged, with the policy's mean action.
    eval_episodes: int = 200
    # Scenes on which the last checkpoint is judged.
    final_episodes: int = 1000

    def __post_init__(self):
        names = "num_envs", "steps", "iterations", "epochs", "minibatch", "checkpoint_every"
        check_at_least(self, 1, *names, "eval_episodes", "final_episodes")
        check_at_least(self, 0, "seed", "learning_rate", "clip", "entropy")
        check_share(self, "gamma", "gae_lambda")
