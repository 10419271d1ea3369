"""World model: sequence form against step form, and the time step that each entry belongs to."""

from functools import partial

import pytest
import torch
from small import CONSTANTS, make_model
from tensordict import TensorDict

from dynmap_rl.keys import DYNAMICS
from dynmap_rl.modules.actor import make_policy_module, make_world_model_module
from dynmap_rl.modules.checkpoints import make_policy, make_world_model
from dynmap_rl.modules.recurrent import delay

CONSTANTS = CONSTANTS | {q: {"low": [-3.0] * 6, "high": [3.0] * 6} for q in ("velocity", "acceleration")}


def make(supervision=("position", "velocity")):
    torch.manual_seed(0)
    return make_world_model(CONSTANTS, supervision, latent_size=16, hidden_size=24).eval()


def batch(b=2, t=7):
    generator = torch.Generator().manual_seed(1)
    return TensorDict(
        {
            "pixels": torch.randint(0, 256, (b, t, 3, 64, 64), dtype=torch.uint8, generator=generator),
            "action": 0.02 * torch.randn(b, t, 3, generator=generator),
            "goal": torch.rand(b, t, 2, generator=generator),
        },
        [b, t],
    )


@torch.no_grad()
def test_latents_in_the_precision_of_training_are_near_the_exact_ones():
    model, td = make(), batch()
    exact, mixed = model.encode(td["pixels"]), model.encode(td["pixels"], mixed=True)
    assert mixed.dtype == torch.float32
    assert (mixed - exact).abs().max() < 0.02 * exact.abs().max()


@torch.no_grad()
def test_sequence_equals_steps():
    model, td = make(), batch()
    latent = model.encode(td["pixels"])
    predicted, hidden1, hidden2 = model.predict(latent, td["action"])
    state, guess = model.initial_state(2), torch.zeros(2, 16)
    for t in range(7):
        torch.testing.assert_close(predicted[:, t], guess, rtol=1e-5, atol=1e-5)
        torch.testing.assert_close(hidden1[:, t], state[0], rtol=1e-5, atol=1e-5)
        torch.testing.assert_close(hidden2[:, t], state[2], rtol=1e-5, atol=1e-5)
        guess, state = model.step(model.encode(td["pixels"][:, t]), td["action"][:, t], state)


def test_a_window_without_a_batch_is_refused():
    model, td = make(), batch()[0]
    latent = model.encode(td["pixels"])
    for predict in (model.predict, partial(model.transition.imagine, context=2)):
        with pytest.raises(ValueError, match=r"\[B, T, \.\.\.\], got"):
            predict(latent, td["action"])


@pytest.mark.parametrize("kind", ["feedforward", "recurrent"])
@torch.no_grad()
def test_policy_sequence_equals_steps(kind):
    model, td = make(), batch()
    policy = make_policy(CONSTANTS, kind, model, width=20).eval()
    latent = model.encode(td["pixels"])
    _, hidden1, hidden2 = model.predict(latent, td["action"])
    actions = policy(latent, hidden1, hidden2, td["goal"])
    assert actions.shape == (2, 7, 3)
    state = policy.initial_state(2)
    for t in range(7):
        inputs = (x[:, t] for x in (latent, hidden1, hidden2, td["goal"]))
        action, state = policy.step(*inputs, state)
        torch.testing.assert_close(action, actions[:, t], rtol=1e-4, atol=1e-6)


@torch.no_grad()
def test_prediction_for_t_depends_on_nothing_of_t():
    """Changing frame and action at t = 4 changes the predictions from t = 5 on, and none before."""
    model, td = make(), batch()
    changed = td.clone()
    changed["pixels"][:, 4] = 255 - changed["pixels"][:, 4]
    changed["action"][:, 4] += 0.01
    module = make_world_model_module(model)
    a, b = module(td.clone()), module(changed)
    for key in ("predicted_latent", "hidden1", "hidden2", ("predicted_dynamics", "position")):
        different = (a[key] != b[key]).flatten(2).any(-1).any(0)
        assert different.tolist() == [False] * 5 + [True] * 2, key
    assert (a["latent"] != b["latent"]).any(-1).any(0).tolist() == [False] * 4 + [True] + [False] * 2


def test_delay_shifts_by_one_step():
    x = torch.arange(1.0, 7.0).reshape(1, 3, 2)
    assert delay(x).tolist() == [[[0, 0], [1, 2], [3, 4]]]


@pytest.mark.parametrize("supervision", [(), ("velocity",), DYNAMICS])
@torch.no_grad()
def test_tensordict_modules_write_the_declared_keys(supervision):
    model = make(supervision)
    module = make_world_model_module(model)
    out = make_policy_module(make_policy(CONSTANTS, "recurrent", model))(module(batch()))
    assert out["reconstruction", "pixels"].shape == (2, 7, 3, 64, 64)
    assert out["action"].shape == (2, 7, 3)
    predicted = out.get("predicted_dynamics", TensorDict({}))
    assert set(predicted.keys()) == set(supervision)
    assert {("reconstruction", "pixels"), "latent", "hidden1"} <= set(module.out_keys)
    assert len(list(module.parameters())) == len(list(model.parameters()))


@torch.no_grad()
def test_tensordict_modules_take_nested_keys():
    model, td = make(("position",)), batch()
    policy = make_policy(CONSTANTS, "recurrent", model)
    states = (("m", "z_hat"), ("m", "h1"), ("m", "h2"))
    module = make_world_model_module(
        model,
        pixels=("camera", "front"),
        action=("agent", "action"),
        reconstruction=("out", "frame"),
        predicted_dynamics=("out", "dynamics"),
        latent=("m", "z"),
        predicted=states,
    )
    actor = make_policy_module(policy, ("agent", "goal"), ("agent", "planned"), (("m", "z"), *states[1:]))
    renamed = {"camera": {"front": td["pixels"]}, "agent": td.select("action", "goal")}
    out = actor(module(TensorDict(renamed, [2, 7])))
    plain = make_policy_module(policy)(make_world_model_module(model)(td))
    assert torch.equal(out["agent", "planned"], plain["action"])
    assert torch.equal(out["out", "dynamics", "position"], plain["predicted_dynamics", "position"])
    assert torch.equal(out["out", "frame"], plain["reconstruction", "pixels"])
    assert torch.equal(out["m", "z_hat"], plain["predicted_latent"])


@torch.no_grad()
def test_imagined_sequence_equals_steps_on_own_predictions():
    model, td = make(), batch()
    latent = model.encode(td["pixels"])
    predicted, hidden1, hidden2 = model.transition.imagine(latent, td["action"], context=3)
    state, guess = model.initial_state(2), None
    for t in range(6):
        guess, state = model.step(latent[:, t] if t < 3 else guess, td["action"][:, t], state)
        for found, expected in ((predicted, guess), (hidden1, state[0]), (hidden2, state[2])):
            torch.testing.assert_close(found[:, t + 1], expected, rtol=1e-5, atol=1e-5)
    whole = model.transition.imagine(latent, td["action"], context=7)
    for found, expected in zip(whole, model.predict(latent, td["action"]), strict=True):
        torch.testing.assert_close(found, expected)


def test_memories_stay_in_training_mode():
    """In evaluation mode, cuDNN has no gradients, which fine-tuning and imagination need."""
    model = make_model().eval()
    assert not model.training and not model.encoder.training
    assert all(part.training for part in model.modules() if isinstance(part, torch.nn.LSTM))


@torch.no_grad()
@pytest.mark.parametrize("batch", [(), (0,), (2, 0), (2, 3)])
def test_steps_and_decoders_take_any_batch(batch):
    model = make()
    frames = torch.zeros(*batch, 3, 64, 64, dtype=torch.uint8)
    latent = model.encode(frames)
    memory = tuple(torch.zeros(*batch, model.hidden_size) for _ in range(4))
    predicted, memory = model.step(latent, torch.zeros(*batch, 3), memory)
    assert predicted.shape == (*batch, model.latent_size)
    assert all(x.shape == (*batch, model.hidden_size) for x in memory)
    states = predicted, memory[0], memory[2]
    assert model.decode_pixels(*states).shape == (*batch, 3, 64, 64)
    assert model.decode_dynamics(*states)["position"].shape == (*batch, 6)
