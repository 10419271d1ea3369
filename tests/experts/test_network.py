"""The shipped experts: complete, deterministic, and good at their task."""

import shutil

import numpy as np
import pytest
import torch
from PIL import Image
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torchrl.envs.utils import ExplorationType, set_exploration_type

from dynmap_rl.envs.scene import scene_seed
from dynmap_rl.envs.tasks import TASKS, get_task
from dynmap_rl.envs.torchrl_env import DynmapBatchedEnv
from dynmap_rl.envs.world import ACCELERATION_LIMIT
from dynmap_rl.experts.network import (
    CHECKPOINTS,
    ExpertNetwork,
    list_checkpoints,
    load_expert,
    make_actor,
    play_to_end,
    task_of_expert,
)
from dynmap_rl.reporting.media import film
from dynmap_rl.utils.files import read_json

TASK = "balance_reaching"
LIMIT = tuple(ACCELERATION_LIMIT)
SHIPPED = sorted((path.parent.name, path.stem) for path in CHECKPOINTS.glob("*/*.safetensors"))


@pytest.mark.parametrize("task", TASKS)
def test_last_checkpoint_succeeds_on_fresh_scenes(task):
    seeds = [scene_seed("exploration", 20_000_000 + i) for i in range(40)]
    worlds = play_to_end(load_expert(task), get_task(task), seeds)
    assert sum(get_task(task).is_success(world) for world in worlds) >= 37


@pytest.mark.parametrize(
    "task", [TASK, *(pytest.param(task, marks=pytest.mark.slow) for task in TASKS if task != TASK)]
)
def test_rollout_is_that_of_the_environment(task):
    """Also past the end of an episode that is over early."""
    seeds, network = [scene_seed("exploration", i) for i in range(4)], load_expert(task)
    worlds = play_to_end(network, get_task(task), seeds)
    env = DynmapBatchedEnv(task, num_envs=4, control="acceleration")
    policy = TensorDictModule(network, in_keys=["state"], out_keys=["action", "scale"])
    td = env.reset(TensorDict({"scene_seed": torch.tensor(seeds)}, [4]))
    for _ in range(120):
        td = env.step(policy(td))["next"].exclude("reward")
    for world, row in zip(worlds, td, strict=True):
        np.testing.assert_array_equal(row["dynamics", "position"], world.position.astype(np.float32))
        assert row["is_success"].item() == get_task(task).is_success(world)


@pytest.mark.parametrize("task, checkpoint", SHIPPED)
def test_every_checkpoint_acts_within_the_carts_limits(task, checkpoint):
    env = DynmapBatchedEnv(task, num_envs=10, seed=0)
    start = env.reset()["state"]
    state = torch.cat([start, 10 * torch.ones_like(start), -10 * torch.ones_like(start)])
    mean, std = load_expert(task, checkpoint)(state)
    assert (mean.abs() <= torch.tensor(LIMIT)).all() and (std > 0).all()
    assert not torch.equal(mean[:10].min(0).values, mean[:10].max(0).values)


@pytest.mark.parametrize("task, checkpoint", SHIPPED)
def test_every_checkpoint_loads_and_has_its_facts(task, checkpoint):
    facts = read_json(CHECKPOINTS / task / f"{checkpoint}.json")
    assert facts["task"] == task
    assert facts["state_size"] == get_task(task).state_size
    assert checkpoint == f"iteration_{facts['iteration']:03d}"
    assert 0 <= facts["drop"] <= 1 and 0 <= facts["success"] <= 1
    assert facts["frames"] > 0 and facts["episodes"] > 0 and facts["position_error"] > 0
    network = load_expert(task, checkpoint)
    share = network.limit / torch.tensor(ACCELERATION_LIMIT)
    assert share[0] == pytest.approx(1 if task == "bin_dropping" else 0.25)
    assert (share == share[0]).all()
    assert not any(p.requires_grad for p in network.parameters())


def test_last_checkpoint_is_the_default_and_loading_is_deterministic():
    state = torch.randn(5, 16)
    mean, _ = load_expert(TASK)(state)
    assert torch.equal(load_expert(TASK, list_checkpoints(TASK)[-1])(state)[0], mean)
    assert not torch.equal(load_expert(TASK, list_checkpoints(TASK)[0])(state)[0], mean)


@pytest.mark.parametrize("as_text", [True, False])
def test_an_expert_is_also_named_by_its_folder(tmp_path, as_text):
    first, second = list_checkpoints("bin_dropping")[:2]
    for path in (CHECKPOINTS / "bin_dropping").glob(f"{first}.*"):
        shutil.copy(path, tmp_path / f"mine{path.suffix}")
    folder = str(tmp_path) if as_text else tmp_path
    assert list_checkpoints(folder) == ["mine"]
    state = torch.randn(5, 20)
    mean, _ = load_expert(folder)(state)
    assert torch.equal(mean, load_expert("bin_dropping", first)(state)[0])
    with pytest.raises(ValueError, match=f"mine, got '{second}'"):
        load_expert(folder, second)


def test_checkpoints_are_in_the_order_of_their_iterations(tmp_path):
    for iteration in (995, 1000, 50):
        (tmp_path / f"iteration_{iteration:03d}.safetensors").touch()
    assert list_checkpoints(tmp_path) == ["iteration_050", "iteration_995", "iteration_1000"]


def test_an_expert_of_states_that_a_task_does_not_have_is_refused():
    assert task_of_expert("balance_reaching", get_task("bin_dropping")).name == "balance_reaching"
    with pytest.raises(ValueError, match="bin_dropping, which balance_reaching does not have"):
        task_of_expert("bin_dropping", get_task("balance_reaching"))


def test_unknown_expert_or_checkpoint_raises(tmp_path):
    for nothing in ("nope", tmp_path, tmp_path / "nope", str(tmp_path / "nope")):
        with pytest.raises(ValueError, match=f"no expert at {nothing}"):
            list_checkpoints(nothing)
        with pytest.raises(ValueError, match=f"no expert at {nothing}"):
            load_expert(nothing)
    with pytest.raises(ValueError, match=f"{list_checkpoints(TASK)[-1]}, got 'nope'"):
        load_expert(TASK, "nope")


def test_mean_stays_within_the_limit():
    mean, scale = ExpertNetwork(16, LIMIT)(1e3 * torch.randn(4, 7, 16))
    assert mean.shape == scale.shape == (4, 7, 3)
    assert (mean.abs() <= torch.tensor(LIMIT)).all()
    assert (scale > 0).all()


def test_actor_samples_and_gives_the_log_probability():
    actor = make_actor(load_expert(TASK))
    with set_exploration_type(ExplorationType.RANDOM):
        td = actor(TensorDict({"state": torch.randn(6, 16)}, [6]))
    assert td["action"].shape == (6, 3)
    assert td["action_log_prob"].shape == (6,)
    normal = torch.distributions.Normal(td["loc"], td["scale"])
    torch.testing.assert_close(td["action_log_prob"], normal.log_prob(td["action"]).sum(-1))
    assert not torch.equal(td["action"], td["loc"])
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        assert torch.equal(actor(td.select("state"))["action"], td["loc"])


@pytest.mark.slow
def test_a_film_shows_the_environments_frames(tmp_path):
    seeds, network = [scene_seed("exploration", i) for i in range(2)], load_expert(TASK)
    film(network, get_task(TASK), seeds, tmp_path / "film.gif")
    env = DynmapBatchedEnv(TASK, num_envs=2, from_pixels=True)
    first = env.reset(TensorDict({"scene_seed": torch.tensor(seeds)}, [2]))["pixels"]
    first = torch.cat([*first.permute(0, 2, 3, 1)], 1).numpy().astype(int)
    with Image.open(tmp_path / "film.gif") as picture:
        shown = np.asarray(picture.convert("RGB").resize((256, 64), Image.Resampling.NEAREST)).astype(int)
    assert abs(shown[:, :128] - first).mean() < 5, "a GIF has 256 colours"
