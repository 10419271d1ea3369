"""The loop over windows: it resumes to the same weights, and stops before a bad state is saved."""

from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch
from small import WORLD_MODEL, Stop, make_episodes, make_model

from dynmap_rl.data.augmentation import augment
from dynmap_rl.data.settings import Augmentation
from dynmap_rl.runs.folder import append_metrics, load_training_state, read_metrics
from dynmap_rl.training import loop
from dynmap_rl.training.loop import check_loss
from dynmap_rl.training.settings import EndToEndTraining, JointTraining, WorldModelTraining, windows_at
from dynmap_rl.training.world_model import train_world_model
from dynmap_rl.utils.weights import fingerprint


@pytest.mark.parametrize("seed", [0, 1])
def test_a_resumed_training_equals_an_uninterrupted_one(tmp_path, monkeypatch, seed):
    episodes, whole, settings = make_episodes(), make_model(), replace(WORLD_MODEL, seed=seed)
    train_world_model(whole, episodes, tmp_path / "whole", settings, save_every=2)

    save, step, updates = loop.save_training_state, loop.step, []

    def save_then_stop(path, **state):
        save(path, **state)
        if state["update"] == 4:
            raise Stop

    with monkeypatch.context() as patch, pytest.raises(Stop):
        patch.setattr(loop, "save_training_state", save_then_stop)
        train_world_model(make_model(), episodes, tmp_path / "parts", settings, save_every=2)
    append_metrics(tmp_path / "parts", 5, loss_rgb=0.0)  # written after the last state, then killed
    resumed = make_model()
    monkeypatch.setattr(loop, "step", lambda *args: updates.append(1) or step(*args))
    train_world_model(resumed, episodes, tmp_path / "parts", settings, save_every=2)

    assert len(updates) == 2, "saved updates are not repeated"
    assert fingerprint(resumed) == fingerprint(whole)
    assert read_metrics(tmp_path / "parts") == read_metrics(tmp_path / "whole")


def test_a_training_is_also_saved_once_in_a_while(tmp_path, monkeypatch):
    def train(folder, **patches):
        with monkeypatch.context() as patch:
            for name, value in patches.items():
                patch.setattr(loop, name, value)
            train_world_model(make_model(), make_episodes(), tmp_path / folder, WORLD_MODEL)

    step, updates = loop.step, []

    def stop_at_the_third(*arguments):
        updates.append(1)
        if len(updates) == 3:
            raise KeyboardInterrupt
        return step(*arguments)

    train("whole")
    with pytest.raises(KeyboardInterrupt):
        train("parts", step=stop_at_the_third, SAVE_AFTER=0)
    assert loop.load_training_state(tmp_path / "parts/checkpoint/world_model.pt")["update"] == 2
    train("parts")
    assert read_metrics(tmp_path / "parts") == read_metrics(tmp_path / "whole")


def test_a_folder_with_a_training_of_other_settings_is_refused(tmp_path):
    """Otherwise its weights would be taken for those of the new settings."""
    train_world_model(make_model(), make_episodes(), tmp_path, WORLD_MODEL)
    for change in ({"beta_z": 0.9}, {"updates": 1}, {"seed": 1}):
        with pytest.raises(ValueError, match="other settings"):
            train_world_model(make_model(), make_episodes(), tmp_path, replace(WORLD_MODEL, **change))


def test_a_folder_with_a_training_of_another_model_or_other_data_is_refused(tmp_path):
    train_world_model(make_model(), make_episodes(), tmp_path, WORLD_MODEL)
    with pytest.raises(ValueError, match="another model"):
        train_world_model(make_model(latent_size=12), make_episodes(), tmp_path, WORLD_MODEL)
    for key in ("action", ("dynamics", "position")):
        episodes = make_episodes()
        episodes["train"] = episodes["train"].clone()
        episodes["train"][key] = episodes["train"][key] + 0.1
        with pytest.raises(ValueError, match="other episodes"):
            train_world_model(make_model(), episodes, tmp_path, WORLD_MODEL)


def test_a_training_that_is_older_than_a_setting_has_its_default(tmp_path):
    train_world_model(make_model(), make_episodes(), tmp_path, WORLD_MODEL)
    path = tmp_path / "checkpoint/world_model.pt"
    state = torch.load(path, weights_only=True)
    del state["form"]["labelled"]
    torch.save(state, path)
    train_world_model(make_model(), make_episodes(), tmp_path, WORLD_MODEL)
    with pytest.raises(ValueError, match="other settings"):
        train_world_model(make_model(), make_episodes(), tmp_path, replace(WORLD_MODEL, labelled=0.5))
    del state["form"]  # older still
    torch.save(state, path)
    train_world_model(make_model(), make_episodes(), tmp_path, replace(WORLD_MODEL, updates=8))


def test_a_training_resumes_from_a_state_of_another_kind_of_device(tmp_path):
    """The generators of a GPU have states of another shape."""
    train_world_model(make_model(), make_episodes(), tmp_path, WORLD_MODEL)
    path = tmp_path / "checkpoint/world_model.pt"
    state = torch.load(path, weights_only=True)
    torch.save({**state, "generator": torch.zeros(16, dtype=torch.uint8)}, path)
    train_world_model(make_model(), make_episodes(), tmp_path, replace(WORLD_MODEL, updates=8))
    assert read_metrics(tmp_path)[-1]["step"] == 8


def train_from(update, change, folder, monkeypatch, **changes):
    """Train on windows that are changed from an update on; return the error and the training state."""
    sample, calls = loop.sample_windows, []

    def sample_changed(*args):
        calls.append(1)
        windows = sample(*args)
        return change(windows) if len(calls) > update else windows

    monkeypatch.setattr(loop, "sample_windows", sample_changed)
    with pytest.raises(ValueError, match="lower learning rate") as error:
        train_world_model(
            make_model(), make_episodes(), folder, replace(WORLD_MODEL, updates=60, **changes), save_every=10
        )
    assert all(row["step"] <= update for row in read_metrics(folder))
    return str(error.value), load_training_state(folder / "checkpoint/world_model.pt")


def with_nan(windows):
    windows["dynamics", "position"][:] = float("nan")
    return windows


def exploding(windows):
    windows["dynamics", "position"].mul_(1e6)
    return windows


@pytest.mark.parametrize(("change", "message"), [(with_nan, "not finite"), (exploding, "diverges")])
def test_a_loss_that_is_not_finite_or_diverges_keeps_the_last_state(tmp_path, monkeypatch, change, message):
    error, state = train_from(10, change, tmp_path, monkeypatch)
    assert message in error
    assert state["update"] == 10 and all(value.isfinite().all() for value in state["model"].values())


def test_a_resumed_training_still_knows_its_first_loss(tmp_path, monkeypatch):
    train_world_model(make_model(), make_episodes(), tmp_path, replace(WORLD_MODEL, updates=10))
    sample = loop.sample_windows
    monkeypatch.setattr(loop, "sample_windows", lambda *args: exploding(sample(*args)))
    with pytest.raises(ValueError, match="diverges"):
        train_world_model(make_model(), make_episodes(), tmp_path, replace(WORLD_MODEL, updates=20))


def test_the_learning_rate_warms_up_and_falls_to_2_percent():
    optimizer, rates = SimpleNamespace(param_groups=[{}]), []
    for update in range(1000):
        loop.set_learning_rate(optimizer, 1.0, update, 1000)
        rates.append(optimizer.param_groups[0]["lr"])
    assert rates[0] == pytest.approx(0.01) and rates[49] == pytest.approx(0.5, abs=0.01)
    assert rates[500] == pytest.approx(0.51) and rates[-1] == pytest.approx(0.02, abs=1e-4)


def test_gradients_are_clipped_to_a_norm_of_1():
    parameter = torch.nn.Parameter(torch.zeros(4))
    norm = loop.step((30 * parameter).sum(), torch.optim.SGD([parameter], 1.0))
    assert norm == 60 and parameter.norm().item() == pytest.approx(1.0)


def test_a_learning_rate_that_is_too_high_stops_before_anything_is_saved(tmp_path, monkeypatch):
    _, state = train_from(0, lambda windows: windows, tmp_path, monkeypatch, learning_rate=1e9)
    assert state is None


def test_a_gradient_that_is_not_finite_is_noticed_at_once():
    """The loss of that update is still finite."""
    assert check_loss(2.0, torch.tensor(5.0)) == 2.0
    assert check_loss(2.0, torch.tensor(5.0), 3.0) == 3.0
    with pytest.raises(ValueError, match="not finite"):
        check_loss(2.0, torch.tensor(float("inf")))


@pytest.mark.parametrize("kind", [WorldModelTraining, EndToEndTraining, JointTraining])
def test_short_windows_come_first_and_hold_as_many_frames(kind):
    settings = kind(updates=10, windows=3, window_steps=8, short_windows=0.4)
    assert [windows_at(settings, update) for update in range(10)] == [(6, 4)] * 4 + [(3, 8)] * 6
    assert windows_at(replace(settings, short_windows=0.0), 0) == (3, 8)
    assert windows_at(replace(settings, window_steps=4), 0) == (3, 4)


def test_windows_change_as_the_settings_say():
    windows, generator = make_episodes()["train"], torch.Generator().manual_seed(0)
    same = augment(windows.clone(), generator, Augmentation.off())
    assert (same == windows).all()
    for name, value in vars(Augmentation()).items():
        changes = vars(Augmentation.off()) | {name: value}
        changed = augment(windows.clone(), generator, Augmentation(**changes))
        assert not torch.equal(changed["pixels"], windows["pixels"]), name
        labels = torch.equal(changed["dynamics", "position"], windows["dynamics", "position"])
        assert labels is (name == "recolor")
