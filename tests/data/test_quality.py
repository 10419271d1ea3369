"""Quality of derived columns: films and positions that are good, and bad in one known way."""

from dataclasses import replace

import numpy as np
import pytest
from films import film, make_poses
from robot_dataset import make_robot_dataset

from dynmap_rl.data.camera import FrameSource, measure, read_motion
from dynmap_rl.data.derivatives import differentiate
from dynmap_rl.data.format.reading import read_info
from dynmap_rl.data.motion import Motion
from dynmap_rl.data.quality import LIMITS, Derived, judge_quality, quality_text, worst_episode

NAMES = ["low_x", "low_y", "low_theta", "high_x", "high_y", "high_theta"]
POSES = make_poses(120)
TIME = np.arange(120) / 20


def judge(frames, objects=2):
    motion = measure(frames, (1, 1), FrameSource("tracks", "front", objects), np.arange(len(frames)) / 20)
    velocity, _ = differentiate(motion.position, np.arange(len(frames)) / 20, "savgol")
    return judge_quality([Derived(7, NAMES[: 3 * objects], motion.position, velocity, motion)])


def hide(frames):
    for t in range(0, 120, 8):
        frames[t] = film(POSES[t : t + 1], bodies=[0])[0]
    return frames


def shake(t):
    row = np.arange(96)[:, None, None]
    stripes = np.where((row + 3 * (t % 5)) // 6 % 2, 200, 90)
    return np.broadcast_to(np.where(row < 62, stripes, 220), (96, 96, 3))


def leave():
    poses = POSES.copy()
    poses[..., 0] += 0.25
    return poses


FILMS = {  # check that must fail: film
    None: lambda: film(POSES),
    "lost": lambda: hide(film(POSES)),
    "cut": lambda: film(leave()),
    "size": lambda: film(POSES, scale=0.2),
    "background": lambda: film(POSES, bodies=[0, 1], background=shake),
    "step": lambda: film(POSES[::10], noise=2.0),
}


@pytest.mark.parametrize("fault", FILMS, ids=str)
def test_a_fault_of_a_film_is_found_with_its_place(fault):
    quality = judge(FILMS[fault]())
    bad = {name for name, check in quality["checks"].items() if not check["good"]}
    assert set(quality["checks"]) == set(LIMITS) - {"order"}, "that takes several episodes"
    if fault is None:
        assert bad == set() and quality["verdict"] == "good"
        return
    assert fault in bad and quality["verdict"] == "doubtful"
    assert LIMITS[fault][3] in quality_text(quality)
    if fault == "lost":
        assert quality["checks"]["lost"]["where"] == "high"


def judge_order(films):
    parts = []
    for episode, frames in enumerate(films):
        motion = measure(frames, (1, 1), FrameSource("tracks", "front", 2), TIME)
        velocity, _ = differentiate(motion.position, np.arange(len(frames)) / 20, "savgol")
        parts.append(Derived(episode, NAMES, motion.position, velocity, motion.light()))
    return judge_quality(parts)["checks"].get("order")


def test_objects_that_change_places_between_episodes_are_found():
    films = [film(POSES[:, ::-1] if episode in (1, 4) else POSES) for episode in range(6)]
    check = judge_order(films)
    assert not check["good"] and check["value"] == pytest.approx(1 / 3) and check["episode"] in (1, 4)
    rng = np.random.default_rng(0)
    colors = [[tuple(map(int, color)) for color in rng.integers(0, 140, (2, 3))] for _ in range(6)]
    assert judge_order([film(POSES, colors=some) for some in colors])["good"], "scenes of many colours"
    assert judge_order(films[:2]) is None, "too few to tell"


def judge_state(position):
    velocity, _ = differentiate(position, np.arange(len(position)) / 20)
    return judge_quality([Derived(0, NAMES, position, velocity, Motion(position, [2, 5]))])["checks"]


@pytest.mark.parametrize(
    ("name", "change"),
    [
        ("jumps", lambda p: p + 0.3 * np.isin(np.arange(120), [30, 31, 70])[:, None] * [0, 1, 0, 0, 0, 0]),
        (
            "residual",
            lambda p: p + 0.02 * np.random.default_rng(0).standard_normal(p.shape) * [1, 1, 0, 1, 1, 0],
        ),
        (
            "residual_angle",
            lambda p: p + 0.2 * np.random.default_rng(0).standard_normal(p.shape) * [0, 0, 1, 0, 0, 1],
        ),
    ],
)
def test_a_fault_of_positions_is_found(name, change):
    position = POSES.reshape(120, 6)
    good, bad = judge_state(position), judge_state(change(position))
    assert set(good) == {"jumps", "residual", "residual_angle"}, "a state has no frames"
    assert all(check["good"] for check in good.values()) and not bad[name]["good"]


def test_entries_of_a_state_have_units_of_their_own():
    noise = 0.02 * np.random.default_rng(0).standard_normal(120)
    position = np.stack([POSES[:, 0, 0] + noise, np.linspace(0, 100, 120)], 1)  # m, and a gripper in %
    found = judge_quality([Derived(0, ["x", "grip"], position, position, Motion(position, []))])
    assert found["checks"]["residual"]["where"] == "x" and found["verdict"] == "doubtful"


def test_a_coordinate_that_hardly_moves_is_judged_by_the_extent_of_its_body():
    noise = 1e-3 * np.random.default_rng(0).standard_normal(120)
    position = np.stack([POSES[:, 0, 0], noise], 1)  # m: a hand that stays at its height

    def verdict(names):
        return judge_quality([Derived(0, names, position, position, Motion(position, []))])["verdict"]

    assert verdict(["hand_x", "hand_z"]) == "good"
    assert verdict(["hand_x", "grip"]) == "doubtful"


def test_a_joint_that_rests_in_one_episode_is_no_fault():
    noise = 1e-4 * np.random.default_rng(0).standard_normal((120, 1))
    moves, rests = POSES[:, 0, :1], POSES[:1, 0, :1] + noise
    episodes = [Derived(i, ["x"], p, p, Motion(p, [])) for i, p in enumerate((moves, rests))]
    assert judge_quality(episodes)["verdict"] == "good"


def judge_many(positions, **motion):
    return judge_quality([Derived(i, ["x"], p, p, Motion(p, [], **motion)) for i, p in enumerate(positions)])


def test_a_few_episodes_that_jump_are_found():
    """Of a wrong object or a failed sensor, a single step in some episodes is all that shows."""
    x = POSES[:, 0, :1]
    broken = x + 0.3 * (np.arange(120) > 80)[:, None]
    checks = judge_many([broken if i in (3, 7) else x for i in range(50)])["checks"]
    assert checks["jumps"]["value"] == pytest.approx(2 / 50) and not checks["jumps"]["good"]
    assert checks["residual"]["good"] and checks["jumps"]["episodes"] == [3, 7]
    assert judge_many([broken if i == 3 else x for i in range(50)])["checks"]["jumps"]["good"]


def test_a_switch_may_jump():
    grip = np.repeat([[0.0], [1.0], [0.0]], 40, 0)
    assert judge_many([grip, grip])["verdict"] == "good"
    assert judge_many([grip + 0.1 * POSES[:, 0, :1]])["verdict"] == "doubtful"


def test_shares_of_frames_count_every_frame_alike():
    found = np.ones((60, 1), bool)
    short, long = np.cumsum(np.ones((60, 2)), 0), np.cumsum(np.ones((1200, 2)), 0)
    motions = [Motion(short, [], found=found)] * 9
    motions.append(Motion(long, [], found=np.arange(1200)[:, None] > 540))
    parts = [Derived(e, ["x", "y"], m.position, m.position, m) for e, m in enumerate(motions)]
    assert judge_quality(parts)["checks"]["lost"]["value"] == pytest.approx(541 / (9 * 60 + 1200))


def test_a_tracked_object_that_rests_in_one_episode_is_no_fault():
    motion = measure(film(POSES), (1, 1), FrameSource("tracks", "front", 2), TIME)
    rng, parts = np.random.default_rng(0), []
    for episode in range(5):
        position, velocity = motion.position.copy(), np.gradient(motion.position, 1 / 20, axis=0)
        if episode == 2:
            position[:] = position[:1] + 0.05 * rng.standard_normal(position.shape) * [1, 1, 0, 1, 1, 0]
            velocity = rng.standard_normal(velocity.shape)
        other = velocity[::-1] if episode == 2 else velocity
        parts.append(Derived(episode, NAMES, position, velocity, replace(motion, other=other)))
    quality = judge_quality(parts)
    assert quality["verdict"] == "good", quality_text(quality)


def test_a_position_that_moves_far_in_every_step_does_not_jump():
    position = POSES.reshape(120, 6) + np.arange(120)[:, None] % 2 * [0, 3, 0, 0, 0, 0]
    assert judge_state(position)["jumps"]["value"] == 0


def test_the_flow_of_every_object_is_compared_with_its_own_velocity():
    velocity = np.gradient(POSES.reshape(120, 6), axis=0)
    motion = measure(film(POSES), (1, 1), FrameSource("tracks", "front", 2), TIME)
    motion = replace(motion, other=velocity * [1, 1, 1, -1, -1, 1])
    quality = judge_quality([Derived(7, NAMES, motion.position, velocity, motion)])
    check = quality["checks"]["agreement"]
    assert check["where"] == "high" and check["value"] == pytest.approx(-1)


def test_the_worst_episode_is_that_of_the_check_farthest_beyond_its_limit():
    """Of some checks the value must be at least the limit."""
    checks = {"lost": {"value": 0.055, "episode": 1}, "size": {"value": 40.0, "episode": 2}}
    for name, check in checks.items():
        check["limit"] = LIMITS[name][0]
    assert worst_episode({"checks": checks}) == 1
    checks["size"]["value"] = 1.0
    assert worst_episode({"checks": checks}) == 2


def test_the_worst_episode_of_tracks_is_that_of_their_own_checks():
    checks = {"jumps": {"value": 1.0, "episode": 1, "where": "hand_x"}}
    for number, where in enumerate(("object1", "object1_y", "picture"), 2):
        checks["lost"] = {"value": 0.01, "episode": number, "where": where}
        for name, check in checks.items():
            check["limit"] = LIMITS[name][0]
        assert worst_episode({"checks": checks}) == 1
        assert worst_episode({"checks": checks}, ["object1_x", "object1_y"]) == number


def test_angles_in_degrees_are_judged_like_those_in_radians():
    noisy = POSES.reshape(120, 6) + 0.2 * np.random.default_rng(0).standard_normal((120, 6)) * [
        0,
        0,
        1,
        0,
        0,
        1,
    ]
    degrees = noisy * np.tile([1, 1, 180 / np.pi], 2)
    motions = Motion(noisy, [2, 5]), Motion(degrees, [2, 5], 360)
    found = [judge_quality([Derived(0, NAMES, m.position, m.position, m)])["checks"] for m in motions]
    assert found[0]["residual_angle"]["value"] == pytest.approx(found[1]["residual_angle"]["value"])


def test_noise_of_positions_is_measured():
    """The smooth trajectory follows a part of the noise: three of the seven steps of its window are free."""
    position = POSES.reshape(120, 6)
    extents = np.ptp(np.quantile(position, [0.05, 0.95], axis=0)[:, [0, 1, 3, 4]], axis=0)
    extent = extents.reshape(2, 2).max(1).min()  # x and y of an object share the larger one
    noisy = position + 0.005 * np.random.default_rng(1).standard_normal(position.shape)
    assert judge_state(noisy)["residual"]["value"] * extent == pytest.approx(0.005 * (4 / 7) ** 0.5, rel=0.25)


def test_the_worst_episode_is_named_and_a_dataset_is_judged(tmp_path):
    root = make_robot_dataset(tmp_path / "robot")
    camera = FrameSource("tracks", "observation.images.top", 1)
    episodes = []
    for episode, motion in read_motion(root, read_info(root), camera):
        position = motion.position.copy()
        if episode == 2:
            position[::5] += 9
        episodes.append(
            Derived(
                episode, camera.names, position, differentiate(position, np.arange(len(position)))[0], motion
            )
        )
    checks = judge_quality(episodes)["checks"]
    assert checks["residual"]["episode"] == 2 and checks["lost"]["value"] == 0


def test_an_episode_without_its_object_makes_a_dataset_doubtful():
    found = np.ones((60, 1), bool)
    whole = Motion(np.cumsum(np.ones((60, 2)), 0), [], found=found)
    gone = replace(whole, found=np.arange(60)[:, None] > 50)
    parts = [
        Derived(e, ["x", "y"], whole.position, whole.position, gone if e == 7 else whole) for e in range(30)
    ]
    quality = judge_quality(parts)
    assert quality["checks"]["lost"]["good"] and not quality["checks"]["gone"]["good"]
    assert quality["verdict"] == "doubtful" and quality["checks"]["gone"]["episode"] == 7
    assert quality["checks"]["gone"]["value"] == pytest.approx(51 / 60)


def test_all_episodes_that_cannot_be_tracked_are_named(tmp_path, monkeypatch):
    from dynmap_rl.data import camera

    root = make_robot_dataset(tmp_path / "robot", (12, 13, 14, 12))
    measured = camera.measure

    def measure_long(frames, *rest):
        if len(frames) == 12:
            raise ValueError("nothing moves")
        return measured(frames, *rest)

    monkeypatch.setattr(camera, "measure", measure_long)
    found = read_motion(root, read_info(root), FrameSource("centroid", "observation.images.top"))
    assert [next(found)[0], next(found)[0]] == [1, 2]
    with pytest.raises(ValueError, match="in episodes 0, 3 nothing moves"):
        next(found)
