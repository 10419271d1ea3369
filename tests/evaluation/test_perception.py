"""Colours in predicted frames, the cart's place in the latent, and the first steps in validation scenes."""

import pytest
import torch
from tensordict import TensorDict
from torch import nn

from dynmap_rl.data.demonstrations import load_dataset, load_meta
from dynmap_rl.envs.scene import GOAL_COLOR, Scene, scene_seed
from dynmap_rl.evaluation import perception as module
from dynmap_rl.evaluation.perception import begin_scenes, color_errors, locate_cart


class Painter(nn.Module):
    """A world model that predicts frames by a function of the true ones."""

    def __init__(self, paint):
        super().__init__()
        self.paint, self.weight = paint, nn.Parameter(torch.zeros(1))

    def encode(self, pixels, mixed=False):
        return pixels.flatten(2).float() / 255

    def predict(self, latent, action):
        return latent, latent[..., :0], latent[..., :0]

    def decode_pixels(self, latent, hidden1, hidden2):
        return self.paint(latent.unflatten(-1, (3, 64, 64)))


@pytest.fixture(scope="module")
def held_out(recording):
    scenes = [Scene.from_dict(r["scene"]) for r in load_meta(recording)["episodes"] if r["split"] == "eval"]
    return load_dataset(recording, "eval"), scenes


def test_perfect_frames_explain_everything(held_out):
    found = color_errors(Painter(lambda frames: frames), *held_out, batch=1)
    perfect = {"object_error": 0, "chroma_explained": 1, "goal_explained": 1, "background_error": 0}
    assert found == pytest.approx(perfect, abs=1e-6)


def test_grey_frames_explain_no_chroma_and_empty_ones_no_goal(held_out):
    episodes, scenes = held_out
    grey = color_errors(
        Painter(lambda frames: frames.mean(2, keepdim=True).expand_as(frames)), episodes, scenes
    )
    assert grey["chroma_explained"] <= 0 < grey["object_error"]
    background = torch.tensor([scene.background_color for scene in scenes])[:, None, :, None, None] / 255
    empty = color_errors(Painter(lambda frames: background.expand_as(frames)), episodes, scenes)
    assert empty["goal_explained"] == pytest.approx(0, abs=1e-6)
    assert empty["object_error"] > grey["object_error"]


def test_half_of_the_deviation_explains_three_quarters(held_out):
    episodes, scenes = held_out
    background = torch.tensor([scene.background_color for scene in scenes])[:, None, :, None, None] / 255
    half = color_errors(Painter(lambda frames: (frames + background) / 2), episodes, scenes)
    assert half["goal_explained"] == pytest.approx(0.75, abs=1e-6)
    assert half["background_error"] == pytest.approx(0, abs=1e-6)


def test_a_goal_painted_everywhere_is_an_error_on_the_background(held_out):
    green = torch.tensor(GOAL_COLOR)[:, None, None] / 255
    found = color_errors(Painter(lambda frames: green.expand_as(frames)), *held_out)
    assert found["goal_explained"] == pytest.approx(1, abs=1e-6)
    assert found["background_error"] > 0.3


def test_the_cart_is_located_where_a_linear_map_puts_it(monkeypatch):
    torch.manual_seed(0)
    episodes = TensorDict({"dynamics": TensorDict({"position": torch.rand(4, 20, 6)}, [4, 20])}, [4, 20])
    mix = torch.randn(6, 6)  # no constant is a mixture of the entries

    def features(world_model, part):
        return TensorDict({"latent": part["dynamics", "position"] @ mix * world_model + 1}, part.batch_size)

    monkeypatch.setattr(module, "compute_features", features)
    assert locate_cart(1.0, episodes[:2], episodes[2:]) < 1e-5
    assert locate_cart(0.0, episodes[:2], episodes[2:]) > 0.1


def test_the_first_steps_are_the_expert_s_in_validation_scenes():
    episodes, scenes = begin_scenes("balance_reaching", 2, steps=4)
    assert episodes.shape == (2, 4) and len(scenes) == 2
    torch.testing.assert_close(episodes["action"], episodes["expert_action"])  # neither noise nor pushes
    again, _ = begin_scenes("balance_reaching", 1, steps=4)
    assert torch.equal(again["pixels"][0], episodes["pixels"][0])
    assert scene_seed("validation", 0) // 100_000_000 == 2
