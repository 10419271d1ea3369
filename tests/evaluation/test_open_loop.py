"""Open-loop errors of a world model, against a model that knows the scene."""

import pytest
import torch
from tensordict import TensorDict

from dynmap_rl.data.demonstrations import load_dataset
from dynmap_rl.evaluation.open_loop import open_loop_errors
from dynmap_rl.modules.checkpoints import make_world_model
from dynmap_rl.modules.normalization import Normalizer

CONSTANTS = {
    "action": {"low": [-0.02, -0.02, -0.05], "high": [0.02, 0.02, 0.05]},
    "goal": {"low": [0.0, 0.0], "high": [1.0, 1.0]},
    **{name: {"low": [0.0] * 6, "high": [1.0] * 6} for name in ("position", "velocity")},
}


def make_model(supervision=("position", "velocity")):
    torch.manual_seed(0)
    return make_world_model(CONSTANTS, supervision, latent_size=16, hidden_size=24).eval()


class Perfect(torch.nn.Module):
    """Knows the scene: latents are true positions of the cart, which follows its actions, and of a resting block."""

    supervision, latent_size, sizes = ("position",), 6, {"position": 6}

    def __init__(self, position: torch.Tensor):
        super().__init__()
        self.position, self.transition = position, torch.nn.Module()
        self.transition.action = Normalizer([-0.02] * 3, [0.02] * 3)
        self.constant = torch.nn.Parameter(torch.zeros(1))

    def encode(self, pixels, mixed=False):
        return self.position[:, : pixels.shape[1]]

    def step(self, latent, action, state):
        return latent + torch.cat([action, torch.zeros_like(action)], -1), state

    def initial_state(self, batch, device=None):
        return (torch.zeros(batch, 1),) * 4

    def decode_dynamics(self, predicted, hidden1, hidden2):
        return {"position": predicted}


def test_open_loop_errors_are_distances_in_mm_and_angles_in_degrees():
    """A scene whose block slides off by 1 mm and 0.01 rad a step, which the model does not know."""
    generator = torch.Generator().manual_seed(0)
    action = 0.01 * torch.randn(2, 20, 3, generator=generator)
    cart = torch.cat([torch.zeros(2, 1, 3), action[:, :-1].cumsum(1)], 1)
    block = torch.arange(20.0)[None, :, None] * torch.tensor([0.0006, 0.0008, 0.01]).expand(2, 1, 3)
    position = torch.cat([cart, block], -1)
    data = {"action": action, "pixels": torch.zeros(2, 20, 1), "dynamics": {"position": position}}
    errors = open_loop_errors(Perfect(position), TensorDict(data, [2, 20]), context=5, horizon=8)
    assert (errors["context"], errors["episodes"]) == (5, 2)
    steps = torch.arange(1.0, 9.0)
    close = {"rtol": 1e-3, "atol": 1e-3}
    torch.testing.assert_close(torch.tensor(errors["model"]["cart_mm"]), torch.zeros(8), **close)
    torch.testing.assert_close(torch.tensor(errors["model"]["block_mm"]), steps, **close)
    torch.testing.assert_close(torch.tensor(errors["model"]["block_deg"]), steps * 0.572958, **close)
    torch.testing.assert_close(torch.tensor(errors["still"]["block_mm"]), steps, **close)
    moved = (cart[:, 5:13, :2] - cart[:, 4:5, :2]).norm(dim=-1).mean(0) * 1000
    torch.testing.assert_close(torch.tensor(errors["still"]["cart_mm"]), moved, **close)


def test_open_loop_errors_on_demonstrations(recording):
    episodes = load_dataset(recording, "eval")
    errors = open_loop_errors(make_model(), episodes, context=3, horizon=4, batch=1)
    together = open_loop_errors(make_model(), episodes, context=3, horizon=4)
    assert errors["model"]["cart_mm"] == pytest.approx(together["model"]["cart_mm"], rel=1e-3)
    assert all(len(column) == 4 for name in ("model", "still") for column in errors[name].values())
    other = CONSTANTS | {"position": {"low": [0.0] * 3, "high": [1.0] * 3}}  # such as the commanded pose
    for model in (make_model(()), make_world_model(other, ("position",), latent_size=16, hidden_size=24)):
        with pytest.raises(ValueError, match="position"):
            open_loop_errors(model, episodes)
    with pytest.raises(ValueError, match=r"120, got 100 \+ 40"):
        open_loop_errors(make_model(), episodes, context=100)


def test_a_world_model_of_other_bodies_is_refused():
    """Puck and hand in three dimensions have six entries too."""
    action = {"low": [-1.0] * 4, "high": [1.0] * 4}
    model = make_world_model(CONSTANTS | {"action": action}, ("position",), latent_size=16, hidden_size=24)
    with pytest.raises(ValueError, match="position, with 6 entries, of cart and block"):
        open_loop_errors(model, TensorDict({}, [1, 20]), context=2, horizon=2)
