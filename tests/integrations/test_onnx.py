"""Export to ONNX: actions of onnxruntime are those of PyTorch."""

import numpy as np
import pytest
import torch
from small import CONSTANTS
from tensordict import TensorDict

from dynmap_rl.envs.scene import scene_seeds
from dynmap_rl.envs.torchrl_env import DynmapBatchedEnv
from dynmap_rl.integrations.onnx import PARTS, OnnxActor, export_to_onnx
from dynmap_rl.modules.checkpoints import make_policy, make_world_model, save_policy, save_world_model
from dynmap_rl.runs.lookup import load_actor

REASON = "needs the extra onnx: uv pip install -e '.[onnx]'"


@pytest.fixture(scope="module")
def packages():
    for name in ("onnx", "onnxscript", "onnxruntime"):
        pytest.importorskip(name, reason=REASON)


@pytest.fixture(scope="module")
def exported(packages, tmp_path_factory):
    """Return the folder of the shipped actor."""
    return export_to_onnx("balance_reaching", tmp_path_factory.mktemp("exported"))


@torch.no_grad()
def play(driver, follower, seeds):
    """Return the actions ``[120, 2, B, 3]`` of two actors on the frames of one closed loop, and the end's positions."""
    env = DynmapBatchedEnv("balance_reaching", len(seeds), from_pixels=True)
    td, actions = env.reset(scene_seed=torch.tensor(seeds)), []
    for _ in range(120):
        both = [act(td["pixels"], td["goal"]) for act in (driver, follower)]
        actions.append(torch.stack(both))
        td = env.step(td.set("action", both[0]))["next"]
    return torch.stack(actions), td["dynamics", "position"]


def in_pytorch(actor):
    memory = TensorDict({})

    def act(pixels, goal):
        nonlocal memory
        td = actor(memory.copy().update({"pixels": pixels, "goal": goal}).auto_batch_size_(1))
        memory = td["next"]
        return td["action"]

    return act


@pytest.mark.slow
def test_parity_in_closed_loop_over_120_steps(exported):
    actor = load_actor("balance_reaching").eval()
    actor.mixed = False  # float32, as in ONNX
    onnx, seeds = OnnxActor(exported), scene_seeds("validation", 3)

    def act(pixels, goal):
        return torch.from_numpy(onnx.act(pixels.numpy(), goal.numpy()))

    # On the same frames: separate loops part once a pixel differs, since tipping blocks amplify rounding errors.
    actions, end = play(act, in_pytorch(actor), seeds)
    torch.testing.assert_close(actions[:, 0], actions[:, 1], atol=1e-5, rtol=0)
    assert actions.std() > 1e-3
    _, other_end = play(in_pytorch(actor), in_pytorch(actor), seeds)
    torch.testing.assert_close(end, other_end, atol=1e-2, rtol=0)  # m, rad


@pytest.mark.slow
def test_a_reset_and_any_batch_size(exported):
    actor, generator = OnnxActor(exported), np.random.default_rng(0)
    pixels, goal = generator.integers(256, size=(3, 3, 64, 64), dtype=np.uint8), generator.random((3, 2))
    first = actor.act(pixels, goal)
    assert not np.allclose(actor.act(pixels, goal), first, atol=1e-6)
    actor.reset()
    np.testing.assert_allclose(actor.act(pixels[1:2], goal[1:2]), first[1:2], atol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize(("architecture", "size", "cameras"), [("glimpse", 64, 1), ("plain", 96, 2)])
def test_a_feedforward_policy_has_no_memory(packages, tmp_path, architecture, size, cameras):
    torch.manual_seed(0)
    form = {"architecture": architecture, "image_size": size, "cameras": cameras}
    world_model = make_world_model(CONSTANTS, ("position",), 16, 24, **form)
    save_world_model(tmp_path / "run/world_model", world_model)
    policy = make_policy(CONSTANTS, "feedforward", world_model)
    save_policy(tmp_path / "run/seed_0/policy", policy, world_model)
    onnx = OnnxActor(export_to_onnx(tmp_path / "run", tmp_path / "exported"))
    actor = load_actor(tmp_path / "run").eval()
    actor.mixed = False
    act = in_pytorch(actor)
    for _ in range(4):
        pixels = torch.randint(256, (2, 3, size, cameras * size), dtype=torch.uint8)
        goal = torch.rand(2, 2)
        with torch.no_grad():
            expected = act(pixels, goal).numpy()
        np.testing.assert_allclose(onnx.act(pixels.numpy(), goal.numpy()), expected, atol=1e-5)


def test_missing_files_are_named(packages, tmp_path):
    with pytest.raises(ValueError, match=f"{PARTS[0]}.onnx"):
        OnnxActor(tmp_path)
