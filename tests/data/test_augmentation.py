"""Augmentations are symmetries of the scene."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from dynmap_rl.data.augmentation import augment
from dynmap_rl.data.settings import Augmentation
from dynmap_rl.envs.torchrl_env import DynmapBatchedEnv


def make_episodes(num_envs=8, steps=6):
    env = DynmapBatchedEnv(num_envs=num_envs, from_pixels=True, seed=0)
    torch.manual_seed(0)
    return env.rollout(steps)


def cart_center(frame, color):
    """Row and column, in pixels, of the mean of a colour."""
    rows, columns = np.nonzero((frame == np.array(color)[:, None, None]).all(0))
    return rows.mean() + 0.5, columns.mean() + 0.5


def test_pixels_and_positions_stay_together():
    """Where the block is drawn is where the labels say, before and after."""
    episodes = make_episodes()
    out = augment(episodes, torch.Generator().manual_seed(0))
    moved = 0
    for i in range(len(episodes)):
        for td in (episodes, out):
            frame, p = td["pixels"][i, -1].numpy(), td["dynamics", "position"][i, -1]
            center = int((1 - p[4]) * 64), int(p[3] * 64)
            row, column = cart_center(frame, frame[:, *center])
            assert abs(row - float(1 - p[4]) * 64) < 2
            assert abs(column - float(p[3]) * 64) < 2
        moved += not torch.equal(episodes["dynamics", "position"][i], out["dynamics", "position"][i])
    assert moved >= 6


def test_velocity_stays_the_derivative_of_position():
    episodes = make_episodes()
    out = augment(episodes, torch.Generator().manual_seed(1))
    for td in (episodes, out):
        position = td["dynamics", "position"][..., :3]
        velocity = td["dynamics", "velocity"][..., :3]
        middle = (velocity[:, 1:] + velocity[:, :-1]) / 2
        torch.testing.assert_close((position[:, 1:] - position[:, :-1]) / 0.05, middle, atol=1e-4, rtol=1e-3)


def test_goal_moves_with_the_cart():
    episodes = make_episodes()
    out = augment(episodes, torch.Generator().manual_seed(2))
    for td in (episodes, out):
        td["apart"] = td["goal"] - td["dynamics", "position"][..., :2]
    torch.testing.assert_close(out["apart"].abs(), episodes["apart"].abs(), atol=1e-6, rtol=0)


def test_a_mirrored_window_is_mirrored_in_all_its_entries():
    episodes = make_episodes()
    episodes["expert_action"] = 2 * episodes["action"]
    out = augment(episodes, torch.Generator().manual_seed(0), Augmentation(max_shift=0, recolor=False))
    mirrored = (out["goal"] != episodes["goal"]).any(-1)[:, 0]
    assert 0 < mirrored.sum() < 8
    for a, b, flip in zip(out, episodes, mirrored, strict=True):
        sign = torch.tensor([-1.0, 1.0, -1.0]) if flip else torch.ones(3)
        assert torch.equal(a["pixels"], b["pixels"].flip(-1) if flip else b["pixels"])
        for key in ("action", "expert_action"):
            assert torch.equal(a[key], b[key] * sign)
        for quantity in ("velocity", "acceleration"):
            assert torch.equal(a["dynamics", quantity], b["dynamics", quantity] * sign.repeat(2))
        angles = [td["dynamics", "position"][:, [2, 5]] for td in (a, b)]
        assert torch.equal(angles[0], angles[1] * sign[2])


def test_options_leave_the_other_changes_as_they_are():
    episodes = make_episodes()
    every, same_colors = (
        augment(episodes, torch.Generator().manual_seed(3), Augmentation(recolor=r)) for r in (True, False)
    )
    assert (every.exclude("pixels") == same_colors.exclude("pixels")).all()
    assert not torch.equal(every["pixels"], same_colors["pixels"])
    assert torch.equal(every["pixels"].sum(2), same_colors["pixels"].sum(2)), "channels are permuted"
    plain = augment(episodes, torch.Generator().manual_seed(3), Augmentation(mirror=False))["goal"]
    assert torch.equal(plain[..., 1], every["goal"][..., 1]) and not torch.equal(plain, every["goal"])
    off = augment(episodes, torch.Generator(), Augmentation(max_shift=0, mirror=False, recolor=False))
    assert (off == episodes.select(*off.keys(True, True))).all()


@pytest.mark.parametrize("size", [2, 3])
def test_a_point_and_a_single_body_change_like_the_first_of_two_bodies(size):
    episodes = make_episodes()
    few = episodes.clone()
    few["dynamics"] = few["dynamics"].apply(lambda x: x[..., :size])
    out, expected = (augment(td, torch.Generator().manual_seed(2)) for td in (few, episodes))
    for quantity, values in out["dynamics"].items():
        assert torch.equal(values, expected["dynamics", quantity][..., :size])
    assert not torch.equal(out["dynamics", "position"], few["dynamics", "position"])


def test_dynamics_that_are_missing_are_not_needed():
    episodes = make_episodes()
    out = augment(episodes.exclude(("dynamics", "position")), torch.Generator().manual_seed(2))
    expected = augment(episodes, torch.Generator().manual_seed(2))
    assert torch.equal(out["dynamics", "velocity"], expected["dynamics", "velocity"])
    assert augment(episodes.exclude("dynamics"), torch.Generator())["goal"].shape == episodes["goal"].shape


def test_frames_of_several_cameras_change_their_colours_alone():
    episodes = make_episodes()
    episodes["pixels"] = torch.cat([episodes["pixels"]] * 2, -1)
    out = augment(episodes, torch.Generator().manual_seed(1), replace(Augmentation.off(), recolor=True))[
        "pixels"
    ]
    assert torch.equal(out[..., :64], out[..., 64:]) and not torch.equal(out, episodes["pixels"])
    assert torch.equal(out.sum(2), episodes["pixels"].sum(2))


def test_windows_of_other_sizes_cannot_be_moved():
    episodes = make_episodes(2, 2)
    episodes["goal"] = torch.zeros(2, 2, 3)
    with pytest.raises(ValueError, match=r"got \{'action': 3, 'goal': 3\}"):
        augment(episodes, torch.Generator())
    assert (augment(episodes, torch.Generator(), Augmentation.off())["goal"] == 0).all()


def test_no_next_observation_contradicts_the_one_that_follows():
    episodes = make_episodes()
    out = augment(episodes, torch.Generator().manual_seed(0))
    assert not {"pixels", "goal", "dynamics", "agent_pos", "state"} & set(out["next"].keys())
    assert torch.equal(out["next", "reward"], episodes["next", "reward"])
    assert "pixels" in episodes["next"].keys(), "the caller's windows are left as they are"
