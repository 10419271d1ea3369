import pytest
import torch
from tensordict import TensorDict
from torch.nn.functional import pixel_shuffle, pixel_unshuffle

from dynmap_rl.modules.decoder import DYNAMICS
from dynmap_rl.modules.encoder import Encoder
from dynmap_rl.modules.normalization import Normalizer
from dynmap_rl.modules.recurrent import delay
from dynmap_rl.modules.checkpoints import load_policy
from dynmap_rl.modules.checkpoints import load_world_model
from dynmap_rl.modules.checkpoints import make_policy
from dynmap_rl.modules.actor import make_policy_module
from dynmap_rl.modules.checkpoints import make_world_model
from dynmap_rl.modules.actor import make_world_model_module
from dynmap_rl.modules.checkpoints import save_policy
from dynmap_rl.modules.checkpoints import save_world_model
from dynmap_rl.modules.layers import to_blocks

CONSTANTS = {
    "action": {"low": [-0.02, -0.02, -0.05], "high": [0.02, 0.02, 0.05]},
    "goal": {"low": [0.0, 0.0], "high": [1.0, 1.0]},
    "position": {"low": [0.0] * 6, "high": [1.0] * 6},
    "velocity": {"low": [-0.4] * 6, "high": [0.4] * 6},
    "acceleration": {"low": [-3.0] * 6, "high": [3.0] * 6},
}


def make(supervision=("position", "velocity"), **arguments):
    torch.manual_seed(0)
    return make_world_model(CONSTANTS, supervision, latent_size=16, hidden_size=24, **arguments).eval()


def batch(b=2, t=7):
    generator = torch.Generator().manual_seed(1)
    return TensorDict(
        {
            "pixels": torch.randint(0, 256, (b, t, 3, 64, 64), dtype=torch.uint8, generator=generator),
            "action": 0.02 * torch.randn(b, t, 3, generator=generator),
            "goal": torch.rand(b, t, 2, generator=generator),
            "dynamics": {q: torch.rand(b, t, 6, generator=generator) for q in DYNAMICS},
        },
        [b, t],
    )


def test_normalizer_maps_the_range_to_plus_minus_one_and_back():
    normalizer = Normalizer([0.0, -2.0], [1.0, 4.0])
    assert normalizer.normalize(torch.tensor([[0.0, -2.0], [1.0, 4.0]])).tolist() == [[-1, -1], [1, 1]]
    x = torch.randn(5, 2)
    torch.testing.assert_close(normalizer.denormalize(normalizer.normalize(x)), x)
    with pytest.raises(ValueError, match="below"):
        Normalizer([0.0], [0.0])


@pytest.mark.parametrize("keypoints", [True, False])
def test_encoder_keeps_leading_axes_and_refuses_other_frames(keypoints):
    encoder = Encoder(16, keypoints=keypoints)
    frames = torch.randint(0, 256, (2, 3, 3, 64, 64), dtype=torch.uint8)
    latent = encoder(frames)
    assert latent.shape == (2, 3, 16)
    torch.testing.assert_close(encoder(frames[0, 0]), latent[0, 0], rtol=1e-4, atol=1e-5)
    with pytest.raises(ValueError, match="64"):
        encoder(torch.zeros(1, 3, 32, 32))


def test_frames_as_blocks_and_back():
    frames = torch.randint(0, 256, (5, 3, 64, 64), dtype=torch.uint8)
    for pixels in (
        frames,
        frames.float(),
        frames.repeat(1, 1, 1, 2)[..., 4:68],
    ):  # the last is no whole memory
        blocks = to_blocks(pixels)
        assert blocks.is_contiguous(memory_format=torch.channels_last)
        assert torch.equal(pixel_shuffle(blocks, 4), pixels)
    assert blocks[1, :, 2, 3].tolist() == pixels[1, :, 8:12, 12:16].flatten().tolist()


@torch.no_grad()
def test_a_frame_s_scale_and_colour_reach_the_latent():
    """Scaled weights on raw bytes are the same as plain weights on a frame in -0.5..0.5, but for the border."""
    encoder = Encoder(16)
    frames = torch.randint(0, 256, (2, 3, 64, 64), dtype=torch.uint8)
    frames[..., [0, -1], :] = frames[..., :, [0, -1]] = 0
    maps = encoder.stem(pixel_unshuffle(frames / 255 - 0.5, 4)).relu()[..., 1:-1, 1:-1]
    seen = []
    encoder.top.register_forward_pre_hook(lambda _, inputs: seen.append(inputs[0][..., 1:-1, 1:-1]))
    latent = encoder(frames)
    torch.testing.assert_close(seen[0], maps, rtol=1e-4, atol=1e-5)
    plain = encoder.project.register_forward_hook(lambda _m, _i, output: 0 * output)
    color = encoder(frames)
    plain.remove()
    torch.testing.assert_close(color, 5 * encoder.color(frames.float().mean((2, 3)) / 255 - 0.5))
    assert not torch.equal(latent, color)


@torch.no_grad()
def test_latents_in_the_precision_of_training_are_near_the_exact_ones():
    model, td = make(), batch()
    exact, mixed = model.encode(td["pixels"]), model.encode(td["pixels"], mixed=True)
    assert mixed.dtype == torch.float32
    assert (mixed - exact).abs().max() < 0.02 * exact.abs().max()


def test_sequence_equals_steps():
    model, td = make(), batch()
    with torch.no_grad():
        latent = model.encode(td["pixels"])
        predicted, hidden1, hidden2 = model.predict(latent, td["action"])
        state, guess = model.initial_state(2), torch.zeros(2, 16)
        for t in range(7):
            torch.testing.assert_close(predicted[:, t], guess, rtol=1e-5, atol=1e-5)
            torch.testing.assert_close(hidden1[:, t], state[0], rtol=1e-5, atol=1e-5)
            torch.testing.assert_close(hidden2[:, t], state[2], rtol=1e-5, atol=1e-5)
            guess, state = model.step(model.encode(td["pixels"][:, t]), td["action"][:, t], state)


@pytest.mark.parametrize("kind", ["feedforward", "recurrent"])
def test_policy_sequence_equals_steps(kind):
    model, td = make(), batch()
    policy = make_policy(CONSTANTS, kind, model, width=20).eval()
    with torch.no_grad():
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
def test_prediction_for_t_sees_nothing_of_t():
    """Changing frame and action at t = 4 changes what is predicted from t = 5 on, and nothing before."""
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


def test_checkpoints_are_complete(tmp_path):
    model = make()
    policy = make_policy(CONSTANTS, "recurrent", model, width=20)
    save_world_model(tmp_path / "model", model)
    save_policy(tmp_path / "policy", policy, model)
    for saved, loaded in (
        (model, load_world_model(tmp_path / "model")),
        (policy, load_policy(tmp_path / "policy")),
    ):
        assert type(saved) is type(loaded)
        for name, value in saved.state_dict().items():
            assert torch.equal(value, loaded.state_dict()[name]), name


def test_bad_checkpoints_are_named(tmp_path):
    with pytest.raises(ValueError, match="no checkpoint"):
        load_world_model(tmp_path)
    save_world_model(tmp_path, make())
    path = tmp_path / "weights.safetensors"
    path.write_bytes(path.read_bytes()[:1000])
    with pytest.raises(ValueError, match="weights.safetensors"):
        load_world_model(tmp_path)


def test_unknown_names_are_refused():
    with pytest.raises(ValueError, match="recurrent"):
        make_policy(CONSTANTS, "transformer", make())
    with pytest.raises(KeyError):
        make(("jerk",))
