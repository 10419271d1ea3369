"""Training and evaluation: the world model, closed-loop episodes."""

from __future__ import annotations

import gymnasium as gym
import torch
from timing import compare, seconds
from torch import nn

import dynmap_rl  # noqa: F401  (registers the ids)
from dynmap_rl.data import load_dataset, load_meta, sample_windows
from dynmap_rl.envs.scene import scene_seeds
from dynmap_rl.envs.world import EPISODE_STEPS
from dynmap_rl.evaluation.rollout import roll_out
from dynmap_rl.modules.actor import Actor
from dynmap_rl.modules.checkpoints import make_policy, make_world_model
from dynmap_rl.modules.precision import mixed_precision
from dynmap_rl.modules.world_model import WorldModel
from dynmap_rl.objectives.world_model import WorldModelLoss, rms
from dynmap_rl.training.loop import make_optimizer, step

SUPERVISION = ("position", "velocity")


def world_model_training(
    dataset: str, decode_all: bool = True, count: int = 16, steps: int = 24, updates: int = 10
) -> dict:
    """Frames a second of a training step of ``recipes/decoupled.py`` with plain CNNs, against the same model
    in plain float32 with LSTM cells in a time loop, which decodes every frame (or as many as the recipe does)."""
    torch.set_num_threads(2)
    episodes = load_dataset(dataset, "train")
    constants = load_meta(dataset)["normalization"]
    windows = sample_windows(episodes, count, steps, torch.Generator().manual_seed(0))
    fast = make_world_model(constants, SUPERVISION, architecture="plain").to(
        memory_format=torch.channels_last
    )
    loss_module = WorldModelLoss(fast, rgb_frames=128, generator=torch.Generator())
    optimizer = make_optimizer(fast, 1e-4, 1e-4)

    def ours():
        def run():
            for _ in range(updates):
                with mixed_precision("cpu"):
                    losses = loss_module(windows)
                step(sum(losses.values()), optimizer)

        return updates * count * steps / seconds(run)

    slow = PlainWorldModel(make_world_model(constants, SUPERVISION, architecture="plain"))
    plain_optimizer = torch.optim.AdamW(slow.parameters(), 1e-4)

    def plain():
        def run():
            for _ in range(updates):
                loss = slow.loss(windows, None if decode_all else 8)
                plain_optimizer.zero_grad()
                loss.backward()
                nn.utils.clip_grad_norm_(slow.parameters(), 1.0)
                plain_optimizer.step()

        return updates * count * steps / seconds(run)

    return compare(ours, plain, repeats=5)


class PlainWorldModel(nn.Module):
    """The same layers as one would first write it: float32, channels first, one ``LSTMCell`` step after the other."""

    def __init__(self, model: WorldModel):
        super().__init__()
        self.model = model
        layers = model.transition.lstm.lstm1, model.transition.lstm.lstm2
        self.cells = nn.ModuleList(nn.LSTMCell(layer.input_size, layer.hidden_size) for layer in layers)
        for cell, layer in zip(self.cells, layers, strict=True):
            cell.load_state_dict({k.removesuffix("_l0"): v for k, v in layer.state_dict().items()})

    def loss(self, windows, rgb_frames: int | None) -> torch.Tensor:
        model, pixels = self.model, windows["pixels"]
        encoder = model.encoder
        frames = pixels.flatten(0, 1).float() / 255
        blocks = (
            nn.functional.pad(nn.functional.pixel_unshuffle(frames, 4), (1, 1, 1, 1)) - 0.5
        )  # black around
        stem = nn.functional.conv2d(blocks, encoder.stem.weight, encoder.stem.bias)
        maps = encoder.top(stem.relu()).flatten(1)
        color = 5 * encoder.color(frames.mean((2, 3)) - 0.5)
        latent = (encoder.project(maps) + color).unflatten(0, pixels.shape[:2])
        action = model.transition.action.normalize(windows["action"])
        states = [[torch.zeros(len(pixels), model.hidden_size) for _ in range(2)] for _ in self.cells]
        outputs = []
        for t in range(pixels.shape[1] - 1):
            below = torch.cat([latent[:, t], action[:, t]], -1)
            for i, cell in enumerate(self.cells):
                states[i] = list(cell(below, states[i]))
                below = states[i][0]
            outputs.append((latent[:, t] + model.transition.change(below), states[0][0], below))
        predicted, hidden1, hidden2 = (torch.stack(x, 1) for x in zip(*outputs, strict=True))
        target = frames.unflatten(0, pixels.shape[:2])[:, 1:]
        chosen = torch.randperm(target.shape[1])[:rgb_frames]
        decoded = model.decode_pixels(predicted[:, chosen], hidden1[:, chosen], hidden2[:, chosen])
        loss = rms((decoded - target[:, chosen]).flatten(-3)).mean()
        change = predicted - latent[:, :-1] + latent[:, :-1].detach()
        loss = loss + 0.1 * rms(change - latent[:, 1:].detach()).mean()
        for name, value in model.decode_dynamics(predicted, hidden1, hidden2).items():
            scale = model.dynamics_decoder.normalizers[name].scale
            loss = loss + rms((value - windows["dynamics", name][:, 1:]) / scale).mean()
        return loss


def evaluation(dataset: str, episodes: int = 1000, single: int = 5) -> dict:
    """Seconds an episode: 1,000 of them as one batch, against one after the other through the Gymnasium id; both encode
    frames in the precision of training."""
    torch.set_num_threads(1)
    constants = load_meta(dataset)["normalization"]
    world_model = make_world_model(constants, SUPERVISION).eval()
    policy = make_policy(constants, "recurrent", world_model).eval()

    def ours():
        actor = Actor(world_model, policy, mixed=True)
        return seconds(lambda: roll_out(actor, "balance_reaching", scene_seeds("test", episodes))) / episodes

    env = gym.make("dynmap_rl/BalanceReaching-v1", obs_type="pixels_agent_pos")

    @torch.no_grad()
    def one_at_a_time():
        steps = 0

        def run():
            nonlocal steps
            for seed in range(single):
                observation, _ = env.reset(seed=seed)
                state, memory = world_model.initial_state(1), policy.initial_state(1)
                done = False
                while not done:
                    frame = torch.from_numpy(observation["pixels"]).permute(2, 0, 1)[None]
                    goal = torch.from_numpy(observation["agent_pos"])[None, 3:]
                    latent = world_model.encode(frame, mixed=True)
                    action, memory = policy.step(latent, state[0], state[2], goal, memory)
                    _, state = world_model.step(latent, action, state)
                    observation, _, terminated, truncated, _ = env.step(action[0].numpy())
                    done = terminated or truncated
                    steps += 1

        time = seconds(run)
        return time / steps * EPISODE_STEPS  # an episode that drops the block ends early

    return compare(ours, one_at_a_time, repeats=2)
