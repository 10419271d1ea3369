"""Training and control on a GPU, and training steps that do not wait for it; skipped where there is none."""

import pytest
import torch
from small import POLICY, WORLD_MODEL

from dynmap_rl.data.augmentation import augment
from dynmap_rl.data.demonstrations import load_dataset, load_meta
from dynmap_rl.data.features import compute_features
from dynmap_rl.data.windows import sample_windows
from dynmap_rl.envs.scene import scene_seeds
from dynmap_rl.evaluation.rollout import roll_out
from dynmap_rl.modules.actor import Actor
from dynmap_rl.modules.checkpoints import make_policy, make_world_model
from dynmap_rl.modules.precision import mixed_precision
from dynmap_rl.objectives.imitation import ImitationLoss
from dynmap_rl.objectives.joint import JointLoss
from dynmap_rl.objectives.world_model import WorldModelLoss
from dynmap_rl.training.loop import make_optimizer, step
from dynmap_rl.training.policy import train_policy
from dynmap_rl.training.world_model import train_world_model

pytestmark = pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")


@pytest.mark.parametrize("trained", ["world_model", "jointly", "policy"])
def test_a_training_step_does_not_wait_for_the_gpu(recording, trained):
    episodes = load_dataset(recording, "train").exclude("next").to("cuda")
    constants = load_meta(recording)["normalization"]
    model = make_world_model(constants, ("position",)).cuda()
    policy = make_policy(constants, "recurrent", model).cuda()
    generator = torch.Generator("cuda").manual_seed(0)
    features = compute_features(model, episodes).to("cuda")
    world_model_loss = WorldModelLoss(model, rgb_frames=2)
    loss_module = {
        "world_model": world_model_loss,
        "jointly": JointLoss(world_model_loss, policy, emphasis=60.0),
        "policy": ImitationLoss(policy, emphasis=60.0),
    }[trained]
    optimizer = make_optimizer(loss_module, 1e-3, 1e-4)

    def train() -> None:
        if trained == "policy":
            batch = features[torch.randint(len(features), (2,), generator=generator, device="cuda")]
        else:
            batch = augment(sample_windows(episodes, 4, 8, generator), generator)
        with mixed_precision("cuda"):
            losses = loss_module(batch)
        step(sum(losses.values()), optimizer)

    train()  # the first time, kernels are loaded
    torch.cuda.set_sync_debug_mode("error")
    try:
        with torch.profiler.profile() as profile:  # sees those that are below torch, too
            train()
    finally:
        torch.cuda.set_sync_debug_mode("default")
    assert not [event for event in profile.events() if event.name == "cudaStreamSynchronize"]


def test_training_and_control_end_to_end(recording, tmp_path):
    episodes = {split: load_dataset(recording, split) for split in ("train", "eval")}
    constants = load_meta(recording)["normalization"]
    model = make_world_model(constants, ("position",)).cuda()
    train_world_model(model, episodes, tmp_path, WORLD_MODEL)
    model.eval().requires_grad_(False)
    features = compute_features(model, episodes["train"])
    policy = make_policy(constants, "recurrent", model).cuda()
    train_policy(policy, features, features, tmp_path / "policy", POLICY)
    rollout = roll_out(Actor(model, policy), "balance_reaching", scene_seeds("validation", 2))
    assert rollout.device is None or rollout.device.type == "cpu"
    assert rollout["action"].isfinite().all()
