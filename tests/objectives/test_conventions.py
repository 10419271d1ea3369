"""All losses follow TorchRL: declared keys, keys under other names, and masks of valid steps."""

import pytest
import torch
from small import CONSTANTS, make_model
from tensordict import TensorDict

from dynmap_rl.modules.checkpoints import make_policy
from dynmap_rl.objectives.imitation import ImitationLoss
from dynmap_rl.objectives.joint import JointLoss
from dynmap_rl.objectives.world_model import WorldModelLoss

KEYS = {
    "pixels": ("camera", "front"),
    "action": ("agent", "action"),
    "dynamics": ("privileged", "truth"),
    "labelled": ("privileged", "known"),
    "goal": ("agent", "target"),
    "expert_action": ("agent", "wanted"),
    "disturbed": ("info", "pushed"),
    "step_count": ("info", "step"),
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
            "expert_action": 0.02 * torch.randn(B, T, 3, generator=generator),
            "disturbed": torch.rand(B, T, 1, generator=generator) < 0.3,
            "step_count": 3 + torch.arange(T).expand(B, T)[..., None],
            "dynamics": {"position": torch.rand(B, T, 6, generator=generator)},
            "labelled": torch.arange(T).expand(B, T)[..., None] % 3 > 0,
            **{key: torch.randn(B, T, size, generator=generator) for key, size in SIZES.items()},
        },
        [B, T],
    )


def make(name, **arguments):
    model = make_model()
    policy = make_policy(CONSTANTS, "recurrent", model, width=16)
    if name == "imitation":
        return ImitationLoss(policy, **arguments)
    loss = WorldModelLoss(model, **arguments)
    return loss if name == "world model" else JointLoss(loss, policy, end_to_end=name == "end to end")


every_loss = pytest.mark.parametrize("name", ["world model", "imitation", "joint", "end to end"])


@every_loss
def test_a_loss_reads_and_writes_the_keys_that_it_declares(name, td):
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
    with pytest.raises(ValueError, match="nope"):
        loss.set_keys(nope="nope")


def test_a_joint_loss_takes_the_keys_of_its_world_model_loss(td):
    inner = make("world model")
    inner.set_keys(action=("agent", "action"))
    joint = JointLoss(inner, make("imitation").policy)
    joint(td.rename_key_("action", ("agent", "action")))
    assert joint.tensor_keys.action == ("agent", "action")


@every_loss
@pytest.mark.parametrize("axes", [2, 3])
def test_masked_steps_do_not_count(name, axes, td):
    """The second of two windows ends with padding, of which some entries are not finite."""
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


def test_masking_the_end_of_windows_equals_cutting_it_off(td):
    loss = make("world model")
    td["collector", "mask"] = (torch.arange(T) < 4).expand(B, T)
    cut = loss(td.exclude("collector")[:, :4])
    for key, value in loss(td).items():
        torch.testing.assert_close(value, cut[key])


def test_the_mask_is_that_of_the_decoded_frames(td):
    loss = make("world model", rgb_frames=B * T // 2)
    td["collector", "mask"] = (torch.arange(T) < T - 2).expand(B, T)
    changed = td.clone()
    changed["pixels"][:, T - 2 :] = 255 - changed["pixels"][:, T - 2 :]
    losses = []
    for some in (td, changed):
        torch.manual_seed(0)
        losses.append(loss(some)["loss_rgb"])
    torch.testing.assert_close(*losses)


def test_a_mask_without_valid_steps_gives_zero_with_few_decoded_frames(td):
    loss = make("world model", rgb_frames=2)
    td["collector", "mask"] = torch.zeros(B, T, dtype=torch.bool)
    assert all(value == 0 for value in loss(td).values())


@every_loss
def test_other_input_than_windows_of_one_episode_is_refused(name, td):
    loss = make(name)
    for wrong in (td.reshape(-1), td[0], td[:, :0]):
        with pytest.raises(ValueError, match="windows"):
            loss(wrong)
    begins = torch.zeros(B, T, 1, dtype=torch.bool)
    begins[0, 0] = True
    loss(td.set("is_init", begins))
    begins[0, 3] = True
    with pytest.raises(ValueError, match="one episode"):
        loss(td)


@every_loss
def test_a_window_may_go_on_after_an_end_only_with_masked_steps(name, td):
    loss, ends = make(name), torch.zeros(B, T, 1, dtype=torch.bool)
    ends[:, -1] = ends[1, 3] = True
    td["next"] = {"done": ends}
    with pytest.raises(ValueError, match="one episode"):
        loss(td)
    td["collector", "mask"] = torch.ones(B, T, dtype=torch.bool)
    td["collector", "mask"][1, 4:] = False
    loss(td)


@every_loss
@pytest.mark.parametrize("key", ["action", "goal", ("dynamics", "position")])
def test_another_number_of_entries_is_refused(name, key, td):
    loss = make(name)
    if key not in loss.in_keys:
        pytest.skip(f"{name} does not read {key}")
    td = td.exclude("expert_action").set(key, td[key][..., :1])
    with pytest.raises(ValueError, match="1]"):
        loss(td)


def test_losses_name_what_they_need():
    with pytest.raises(TypeError, match="WorldModel"):
        WorldModelLoss(torch.nn.Linear(2, 2))
    with pytest.raises(TypeError, match="Normalizer"):
        ImitationLoss(torch.nn.Linear(2, 2))
