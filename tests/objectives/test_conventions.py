"""The losses as TorchRL's: nested keys under other names, declared keys, and masks of valid steps."""

import pytest
import torch
from tensordict import TensorDict

from dynmap_rl.modules.checkpoints import make_policy
from dynmap_rl.modules.actor import make_policy_module
from dynmap_rl.modules.checkpoints import make_world_model
from dynmap_rl.modules.actor import make_world_model_module
from dynmap_rl.objectives.imitation import ImitationLoss
from dynmap_rl.objectives.joint import JointLoss
from dynmap_rl.objectives.world_model import WorldModelLoss
from dynmap_rl.objectives.imitation import imitation_loss

CONSTANTS = {
    "action": {"low": [-0.02, -0.02, -0.05], "high": [0.02, 0.02, 0.05]},
    "goal": {"low": [0.0, 0.0], "high": [1.0, 1.0]},
    "position": {"low": [-2.0] * 6, "high": [2.0] * 6},
}
KEYS = {
    "pixels": ("camera", "front"),
    "action": ("agent", "action"),
    "dynamics": ("privileged", "truth"),
    "goal": ("agent", "target"),
    "disturbed": ("info", "pushed"),
    "latent": ("model", "z"),
    "hidden1": ("model", "h", "1"),
    "hidden2": ("model", "h", "2"),
}
SIZES = {"latent": 16, "hidden1": 24, "hidden2": 24}
B, T = 2, 6


@pytest.fixture
def td():
    generator = torch.Generator().manual_seed(0)
    return TensorDict(
        {
            "pixels": torch.randint(0, 256, (B, T, 3, 64, 64), dtype=torch.uint8, generator=generator),
            "action": 0.02 * torch.randn(B, T, 3, generator=generator),
            "goal": torch.rand(B, T, 2, generator=generator),
            "disturbed": torch.rand(B, T, 1, generator=generator) < 0.3,
            "dynamics": {"position": torch.rand(B, T, 6, generator=generator)},
            **{key: torch.randn(B, T, size, generator=generator) for key, size in SIZES.items()},
        },
        [B, T],
    )


def make(name, **arguments):
    torch.manual_seed(0)
    model = make_world_model(CONSTANTS, ("position",), latent_size=16, hidden_size=24)
    policy = make_policy(CONSTANTS, "recurrent", model, width=16)
    if name == "imitation":
        return ImitationLoss(policy, **arguments)
    loss = WorldModelLoss(model, **arguments)
    return {"world model": loss, "joint": JointLoss(loss, policy)}.get(name) or JointLoss(
        loss, policy, end_to_end=True
    )


every_loss = pytest.mark.parametrize("name", ["world model", "imitation", "joint", "end to end"])


@every_loss
def test_it_reads_and_writes_the_keys_it_declares(name, td):
    loss = make(name)
    losses = loss(td.select(*loss.in_keys))
    assert list(losses.keys()) == loss.out_keys
    assert all(key.startswith("loss_") for key in loss.out_keys)
    for key in loss.in_keys:
        with pytest.raises(KeyError):
            loss(td.select(*loss.in_keys).exclude(key))


@every_loss
def test_every_key_can_be_renamed_and_nested(name, td):
    loss = make(name)
    expected = loss(td)
    names = {key: KEYS[key] for key in vars(loss.tensor_keys)}
    renamed = td.clone()
    for key, other in names.items():
        renamed.rename_key_(key, other)
    loss.set_keys(**names)
    for key, value in loss(renamed).items():
        assert torch.equal(value, expected[key]), key
    assert all(isinstance(key, tuple) for key in loss.in_keys)
    with pytest.raises(ValueError, match="not an accepted tensordict key"):
        loss.set_keys(nope="nope")


def test_a_joint_loss_takes_the_names_of_its_world_model_s_loss(td):
    inner = make("world model")
    inner.set_keys(action=("agent", "action"))
    joint = JointLoss(inner, make("imitation").policy)
    joint(td.rename_key_("action", ("agent", "action")))
    assert joint.tensor_keys.action == ("agent", "action")


@every_loss
@pytest.mark.parametrize("axes", [2, 3])
def test_steps_that_a_mask_leaves_out_do_not_count(name, axes, td):
    """Two windows, the second with padding: what stands in it changes nothing, were it not finite."""
    loss = make(name)
    mask = torch.ones(B, T, dtype=torch.bool)
    mask[1, 4:] = False
    mask = mask if axes == 2 else mask[..., None]
    td["collector", "mask"] = mask
    padded = loss(td)
    changed = td.clone()
    changed["pixels"][1, 4:] = 0
    changed["action"][1, 4:] = 1.0
    changed["dynamics", "position"][1, 4:] = torch.inf
    for key in SIZES:
        changed[key][1, 4:] = 9.0
    for key, value in loss(changed).items():
        torch.testing.assert_close(value, padded[key], rtol=1e-5, atol=1e-6)
    loss.loss_mask_key = None
    unmasked = loss(td)
    assert all(padded[key] != unmasked[key] for key in padded.keys())
    loss.loss_mask_key = ("my", "mask")
    td["my"] = {"mask": mask}
    torch.testing.assert_close(dict(loss(td).items()), dict(padded.items()))


def test_a_masked_loss_is_that_of_the_steps_that_are_left(td):
    """Cut off in every window, or masked in every window: the same."""
    loss = make("world model")
    td["collector", "mask"] = (torch.arange(T) < 4).expand(B, T)
    cut = loss(td.exclude("collector")[:, :4])
    for key, value in loss(td).items():
        torch.testing.assert_close(value, cut[key])


def test_decoding_few_frames_goes_with_a_mask(td):
    loss = make("world model", rgb_steps=2)
    td["collector", "mask"] = torch.zeros(B, T, dtype=torch.bool)
    assert all(value == 0 for value in loss(td).values())


def test_imitation_is_the_function_of_the_policy_s_actions(td):
    loss = make("imitation", emphasis=3.0)
    predicted = loss.policy(*(td[k] for k in (*SIZES, "goal")))
    expected = imitation_loss(predicted, td["action"], loss.policy.action, td["disturbed"], 3.0)
    assert torch.equal(loss(td)["loss_policy"], expected)
    loss(td)["loss_policy"].backward()
    assert all(p.grad is not None for p in loss.policy.parameters())


@torch.no_grad()
def test_tensordict_modules_take_nested_keys(td):
    loss = make("joint")
    model, policy = loss.world_model_loss.world_model, loss.policy
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
    actor = make_policy_module(policy, ("agent", "target"), ("agent", "planned"), (("m", "z"), *states[1:]))
    renamed = TensorDict(
        {"camera": {"front": td["pixels"]}, "agent": {"action": td["action"], "target": td["goal"]}}, [B, T]
    )
    out = actor(module(renamed))
    plain = make_policy_module(policy)(make_world_model_module(model)(td.select("pixels", "action", "goal")))
    assert torch.equal(out["agent", "planned"], plain["action"])
    assert torch.equal(out["out", "dynamics", "position"], plain["predicted_dynamics", "position"])
    assert torch.equal(out["out", "frame"], plain["reconstruction", "pixels"])
    assert torch.equal(out["m", "z_hat"], plain["predicted_latent"])
