"""Settings: frozen, checked, importable without torch."""

import subprocess
import sys
from dataclasses import FrozenInstanceError, fields

import pytest

from dynmap_rl.data.settings import Augmentation
from dynmap_rl.evaluation.settings import Evaluation
from dynmap_rl.training import settings
from dynmap_rl.training.settings import JointTraining, PolicyTraining, PPOTraining, WorldModelTraining

ALL = [kind for kind in vars(settings).values() if isinstance(kind, type)] + [Evaluation]


@pytest.mark.parametrize("kind", ALL, ids=lambda kind: kind.__name__)
def test_settings_are_frozen_and_hashable(kind):
    """Mutable defaults would be shared between runs."""
    values = kind()
    assert hash(values) == hash(kind())
    with pytest.raises(FrozenInstanceError):
        setattr(values, fields(kind)[0].name, None)


@pytest.mark.parametrize(
    ("kind", "values"),
    [
        (WorldModelTraining, {"supervision": "speed"}),
        (WorldModelTraining, {"supervision": "none,position"}),
        (WorldModelTraining, {"updates": 0}),
        (WorldModelTraining, {"window_steps": 1}),
        (WorldModelTraining, {"learning_rate": -1e-3}),
        (WorldModelTraining, {"labelled": 1.1}),
        (WorldModelTraining, {"labelled": -0.1}),
        (WorldModelTraining, {"imagined": 1.5}),
        (WorldModelTraining, {"beta_rgb": -1}),
        (PolicyTraining, {"kind": "transformer"}),
        (PolicyTraining, {"corrections": -1}),
        (JointTraining, {"beta_joint": -1}),
        (JointTraining, {"windows": 0}),
        (JointTraining, {"short_windows": 7}),
        (PPOTraining, {"gamma": 2.0}),
        (PPOTraining, {"epochs": 0}),
        (Augmentation, {"max_shift": -1}),
        (Evaluation, {"split": "train"}),
        (Evaluation, {"episodes": 0}),
        (Evaluation, {"episodes": 1001}),
    ],
)
def test_a_bad_value_is_refused_and_named(kind, values):
    [(name, value)] = values.items()
    with pytest.raises(ValueError, match=rf"\.{name} must .*{value}"):
        kind(**values)


def test_a_world_model_that_would_learn_nothing_is_refused():
    with pytest.raises(ValueError, match=r"beta_rgb must be above 0"):
        WorldModelTraining(supervision="none", beta_rgb=0)


@pytest.mark.parametrize(
    "values",
    [
        {"labelled": 0.5, "supervision": "none"},
        {"beta_dynamics": 2.0, "supervision": "none"},
        {"rarity": 0.0, "beta_rgb": 0.0},
    ],
)
def test_a_value_without_effect_is_refused(values):
    with pytest.raises(ValueError, match=f"{next(iter(values))} has no effect"):
        WorldModelTraining(**values)


def test_torch_is_not_imported():
    code = (
        "import sys; from dynmap_rl.training import WorldModelTraining; from dynmap_rl.evaluation import Evaluation; "
        "WorldModelTraining(), Evaluation(); print('torch' in sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True).stdout == "False\n"


def test_a_supervision_has_one_name():
    for name in ("velocity,position", " position, velocity"):
        assert WorldModelTraining(supervision=name) == WorldModelTraining(supervision="position,velocity")
    with pytest.raises(ValueError, match="nothing would be learned"):
        WorldModelTraining(supervision=" none", beta_rgb=0.0)
