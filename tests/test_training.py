import re
from types import SimpleNamespace

import pytest
import torch
from safetensors.torch import load_file, save_file
from tensordict import TensorDict

from dynmap_rl import frozen  # MODULE
from dynmap_rl import runs  # MODULE
from dynmap_rl import training  # MODULE
from dynmap_rl.data.features import compute_features
from dynmap_rl.data.windows import sample_windows
from dynmap_rl.modules.decoder import DYNAMICS
from dynmap_rl.modules.checkpoints import make_policy
from dynmap_rl.modules.checkpoints import make_world_model
from dynmap_rl.modules.precision import mixed_precision
from dynmap_rl.training.loop import check_loss
from dynmap_rl.training.loop import descend
from dynmap_rl.training.policy import train_policy
from dynmap_rl.training.world_model import train_world_model
from dynmap_rl.utils.weights import fingerprint

CONSTANTS = {
    "action": {"low": [-0.02, -0.02, -0.05], "high": [0.02, 0.02, 0.05]},
    "goal": {"low": [0.0, 0.0], "high": [1.0, 1.0]},
    "position": {"low": [0.0] * 6, "high": [1.0] * 6},
}
SETTINGS = SimpleNamespace(
    logger=None,
    updates=6,
    windows=2,
    window_steps=5,
    rgb_steps=2,
    distractors=2,
    learning_rate=1e-3,
    beta_z=0.1,
    beta_dynamics=1.0,
    world_model_seed=0,
    policy_updates=4,
    policy_batch=2,
    policy_learning_rate=1e-3,
    emphasis=30.0,
    device="cpu",
)


def make_episodes(count=3, steps=12):
    generator = torch.Generator().manual_seed(0)
    return TensorDict(
        {
            "pixels": torch.randint(
                0, 256, (count, steps, 3, 64, 64), dtype=torch.uint8, generator=generator
            ),
            "action": 0.01 * torch.randn(count, steps, 3, generator=generator),
            "goal": torch.rand(count, steps, 2, generator=generator),
            "dynamics": {q: torch.rand(count, steps, 6, generator=generator) for q in DYNAMICS},
        },
        [count, steps],
    )


def make_model():
    torch.manual_seed(0)
    return make_world_model(CONSTANTS, ("position",), latent_size=16, hidden_size=24)


class Stop(Exception):
    pass


def test_a_resumed_world_model_equals_an_uninterrupted_one(tmp_path, monkeypatch):
    episodes = dict.fromkeys(("train", "eval"), make_episodes())
    whole = make_model()
    train_world_model(whole, episodes, tmp_path / "whole", SETTINGS, save_every=2)

    save, calls = runs.save_training_state, []

    def save_then_stop(*args, **state):
        save(*args, **state)
        calls.append(1)
        if len(calls) == 2:
            raise Stop

    monkeypatch.setattr(runs, "save_training_state", save_then_stop)
    with pytest.raises(Stop):
        train_world_model(make_model(), episodes, tmp_path / "parts", SETTINGS, save_every=2)
    runs.append_metrics(tmp_path / "parts", 5, loss_rgb=0.0)  # written after the last state, then killed
    monkeypatch.undo()
    resumed, updates = make_model(), []
    monkeypatch.setattr(training, "descend", lambda optimizer: updates.append(1) or descend(optimizer))
    train_world_model(resumed, episodes, tmp_path / "parts", SETTINGS, save_every=2)

    assert len(updates) == SETTINGS.updates - 4, "what was saved is not trained again"
    assert fingerprint(resumed) == fingerprint(whole)
    assert runs.read_metrics(tmp_path / "parts") == runs.read_metrics(tmp_path / "whole")


def test_weights_are_the_same_with_one_thread_or_two(tmp_path):
    episodes = dict.fromkeys(("train", "eval"), make_episodes())
    models, before = [make_model(), make_model()], torch.get_num_threads()
    try:
        for threads, model in enumerate(models, 1):
            torch.set_num_threads(threads)
            torch.manual_seed(threads)  # what is drawn is drawn by generators of the training's own
            train_world_model(model, episodes, tmp_path / str(threads), SETTINGS)
    finally:
        torch.set_num_threads(before)
    assert fingerprint(models[0]) == fingerprint(models[1]) != fingerprint(make_model())


def test_a_training_goes_on_after_states_of_another_kind_of_device(tmp_path):
    """Whose generators have states of another shape."""
    episodes = dict.fromkeys(("train", "eval"), make_episodes())
    train_world_model(make_model(), episodes, tmp_path, SETTINGS)
    path = tmp_path / "checkpoint/world_model.pt"
    state = torch.load(path, weights_only=True)
    torch.save({**state, "generators": [torch.zeros(16, dtype=torch.uint8)]}, path)
    model, settings = make_model(), SimpleNamespace(**{**vars(SETTINGS), "updates": 8})
    train_world_model(model, episodes, tmp_path, settings)
    assert runs.read_metrics(tmp_path)[-1]["step"] == 8


def test_training_a_policy_leaves_the_world_model_as_it_was(tmp_path):
    model = make_model().eval().requires_grad_(False)
    before = fingerprint(model)
    features = compute_features(model, make_episodes(), copies=1, generator=torch.Generator().manual_seed(0))
    policy = make_policy(CONSTANTS, "recurrent", model, width=16)
    untrained = fingerprint(policy)
    train_policy(policy, features, features, tmp_path, SETTINGS, seed=0)
    assert fingerprint(model) == before
    assert fingerprint(policy) != untrained
    with torch.no_grad():
        next(model.parameters()).add_(1e-6)
    assert fingerprint(model) != before


@pytest.mark.parametrize(("seed", "message"), [(0, "this run is not valid"), (1, "delete the folder")])
def test_a_frozen_world_model_that_changes_stops_the_run(tmp_path, monkeypatch, seed, message):
    """One weight, on the disk, after the policy of a seed is finished: the first, or the last."""
    weights = tmp_path / "world_model/weights.safetensors"

    def work_and_tamper(stages, arguments, count):
        for number, one in enumerate(arguments):
            for stage in stages:
                stage(one)
            if number == seed:
                state = load_file(weights)
                next(iter(state.values())).view(-1)[0] += 1e-6
                save_file(state, weights)

    monkeypatch.setattr(runs, "run_processes", work_and_tamper)
    sizes = {"copies": 1, "test_episodes": 1, "paper_episodes": 1, "split": "validation", "threads": 1}
    settings = SimpleNamespace(task="balance_reaching", policy="feedforward", **sizes, **vars(SETTINGS))
    episodes = dict.fromkeys(("train", "eval"), make_episodes())
    with pytest.raises(ValueError, match=message):
        frozen.train_policies(make_model(), episodes, CONSTANTS, tmp_path, settings, [0, 1])
    assert (tmp_path / f"seed_{seed}/eval.json").exists()
    assert (tmp_path / "seed_1/eval.json").exists() is (seed == 1)


def test_a_policy_that_is_trained_is_judged_without_training_it_again(tmp_path, monkeypatch):
    sizes = {"copies": 1, "test_episodes": 1, "paper_episodes": 1, "split": "validation", "threads": 1}
    settings = SimpleNamespace(task="balance_reaching", policy="feedforward", **sizes, **vars(SETTINGS))
    episodes = dict.fromkeys(("train", "eval"), make_episodes())

    def train(model):
        return frozen.train_policies(model, episodes, CONSTANTS, tmp_path, settings, [0])

    def stop(*args):
        raise Stop

    with monkeypatch.context() as patched, pytest.raises(Stop):
        patched.setattr(frozen, "evaluate", stop)
        train(make_model())
    with monkeypatch.context() as patched:
        patched.setattr(frozen, "train_policy", stop)
        sha = train(make_model())
        assert runs.read_json(tmp_path / "seed_0/eval.json")["world_model_sha256"] == sha
        (tmp_path / "seed_0/eval.json").unlink()
        other = make_model()
        with torch.no_grad():
            next(other.parameters()).add_(1e-3)
        with pytest.raises(Stop):
            train(other)


def test_bfloat16_is_only_for_processors_that_compute_with_it(monkeypatch):
    monkeypatch.setattr(torch.backends.mkldnn, "is_available", lambda: False)
    ones = torch.ones(2, 2)
    with mixed_precision(ones.device):
        assert (ones @ ones).dtype == torch.float32


def test_features_are_the_plain_episodes_first_then_the_copies():
    model = make_model().eval()
    episodes = make_episodes()
    features = compute_features(model, episodes, 2, torch.Generator().manual_seed(0))
    assert features.shape == (9, 12)
    for key in ("action", "goal"):
        assert torch.equal(features[key][:3], episodes[key])
    assert not features["disturbed"][:3].any()
    assert not torch.equal(features["latent"][3:6], features["latent"][:3])
    with torch.no_grad():
        torch.testing.assert_close(features["latent"][:3], model.encode(episodes["pixels"], mixed=True))


def test_a_copy_begins_anywhere_with_an_empty_memory_and_ends_where_the_episode_ends():
    model = make_model().eval()
    episodes = make_episodes()
    features = compute_features(model, episodes, 6, torch.Generator().manual_seed(0))
    starts = set()
    for episode, copy in zip(episodes["action"].repeat(6, 1, 1), features[3:], strict=True):
        [start] = (episode == copy["action"][0]).all(-1).nonzero().tolist()[0]
        starts.add(start)
        left = 12 - start
        assert torch.equal(copy["action"][:left], episode[start:]), "copies are not mirrored"
        assert copy["disturbed"][:, 0].tolist() == [False] * left + [True] * start
        assert not copy["hidden1"][0].any()
    assert len(starts) > 2 and max(starts) < 6


def train_from(update, change, folder, monkeypatch, **settings):
    """Windows are changed from an update on; what is then left of the training."""
    calls = []

    def sample(*args):
        windows = sample_windows(*args)
        calls.append(1)
        return change(windows) if len(calls) > 2 * update else windows  # of two parts each

    monkeypatch.setattr(training, "sample_windows", sample)
    episodes = dict.fromkeys(("train", "eval"), make_episodes())
    with pytest.raises(ValueError, match="what was kept before stays; run again with a lower") as error:
        train_world_model(
            make_model(), episodes, folder, SimpleNamespace(**{**vars(SETTINGS), **settings}), save_every=50
        )
    assert all(row["step"] <= update for row in runs.read_metrics(folder))
    return str(error.value), runs.load_training_state(folder / "checkpoint/world_model.pt")


def with_nan(windows):
    windows["dynamics", "position"][:] = float("nan")
    return windows


def exploding(windows):
    windows["dynamics", "position"].mul_(1e6)
    return windows


@pytest.mark.parametrize(
    ("change", "message"), [(with_nan, "not finite"), (exploding, r"diverges \(\d.*, at first \d")]
)
def test_a_loss_that_is_not_finite_or_diverges_leaves_the_last_good_state(
    tmp_path, monkeypatch, change, message
):
    said, state = train_from(50, change, tmp_path, monkeypatch, updates=100)
    assert re.search(message, said)
    assert state["update"] == 50 and all(value.isfinite().all() for value in state["model"].values())


def test_a_learning_rate_that_is_too_high_stops_before_anything_is_kept(tmp_path, monkeypatch):
    _, state = train_from(0, lambda windows: windows, tmp_path, monkeypatch, updates=100, learning_rate=1e9)
    assert state is None


def test_an_update_that_makes_the_weights_nan_is_noticed_at_once():
    """Its loss is still finite."""
    assert check_loss(2.0, torch.tensor(5.0)) == 2.0
    assert check_loss(2.0, torch.tensor(5.0), 3.0) == 3.0
    with pytest.raises(ValueError, match="not finite"):
        check_loss(2.0, torch.tensor(float("inf")))


def test_a_policys_loss_is_watched_too(tmp_path):
    model = make_model().eval().requires_grad_(False)
    features = compute_features(model, make_episodes(), copies=1, generator=torch.Generator().manual_seed(0))
    features["action"][:] = float("nan")
    with pytest.raises(ValueError, match="not finite"):
        train_policy(make_policy(CONSTANTS, "recurrent", model), features, features, tmp_path, SETTINGS, 0)
    assert runs.read_metrics(tmp_path) == []
