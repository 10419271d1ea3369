"""Encoders with networks of torchvision: shapes, gradients, checkpoints, weights, and what happens without it."""

import sys

import pytest
import torch
from small import CONSTANTS

from dynmap_rl.modules.backbones import ResNetEncoder, ViTEncoder, import_torchvision
from dynmap_rl.modules.checkpoints import load_world_model, make_world_model, save_world_model
from dynmap_rl.training.settings import WorldModelArchitecture
from dynmap_rl.training.world_model import build_world_model

NAMES = "resnet18", "resnet18_imagenet", "vit"


def draw(*shape):
    return torch.randint(0, 256, shape, dtype=torch.uint8, generator=torch.Generator().manual_seed(0))


@pytest.mark.parametrize("architecture", NAMES)
def test_a_frame_has_its_latent_in_any_batch_and_after_saving(tmp_path, architecture):
    model = make_world_model(CONSTANTS, ("position",), 16, 24, architecture, image_size=96, cameras=2)
    pixels = draw(2, 3, 3, 96, 192)
    latent = model.encode(pixels)
    assert latent.shape == (2, 3, 16)
    torch.testing.assert_close(model.encode(pixels[1:, 2:]), latent[1:, 2:], rtol=1e-3, atol=1e-4)
    assert latent.flatten(0, 1).std(0).min() > 1e-4  # of different frames
    save_world_model(tmp_path, model)
    torch.testing.assert_close(load_world_model(tmp_path).encode(pixels), latent, rtol=1e-3, atol=1e-4)


@pytest.mark.parametrize("encoder", [ResNetEncoder, ViTEncoder])
def test_all_weights_are_trained(encoder):
    encoder = encoder(8)
    encoder(draw(4, 3, 64, 64)).square().sum().backward()
    assert all(weight.grad is not None and weight.grad.any() for weight in encoder.parameters())


def test_weights_of_torchvision_are_loaded_where_they_are_asked_for(monkeypatch):
    models = import_torchvision().models
    source = models.resnet18()
    source.bn1.running_mean += 3
    weights = models.ResNet18_Weights.IMAGENET1K_V1
    monkeypatch.setattr(type(weights), "get_state_dict", lambda *arguments, **options: source.state_dict())
    model = build_world_model(CONSTANTS, WorldModelArchitecture("none", "resnet18_imagenet"))
    frames = draw(2, 3, 64, 64)
    x = model.encoder.normalize(frames)
    source.eval()
    x = source.maxpool(source.relu(source.bn1(source.conv1(x))))
    x = source.layer4(source.layer3(source.layer2(source.layer1(x))))
    torch.testing.assert_close(model.encoder.body(model.encoder.normalize(frames)), x, rtol=1e-3, atol=1e-3)


def test_weights_that_cannot_be_loaded_are_one_error(monkeypatch):
    def fail(*arguments, **options):
        raise OSError("no network")

    weights = import_torchvision().models.ResNet18_Weights.IMAGENET1K_V1
    monkeypatch.setattr(type(weights), "get_state_dict", fail)
    with pytest.raises(ValueError, match="no network"):
        build_world_model(CONSTANTS, WorldModelArchitecture("none", "resnet18_imagenet"))


@pytest.mark.parametrize("encoder", [ResNetEncoder, ViTEncoder])
def test_without_torchvision_there_is_one_error(monkeypatch, encoder):
    monkeypatch.setitem(sys.modules, "torchvision", None)
    with pytest.raises(ValueError, match="torchvision"):
        encoder(8)


def test_sizes_that_do_not_fit_are_refused():
    with pytest.raises(ValueError, match="multiple of 32"):
        ResNetEncoder(8, image_size=72)
