"""Positions and angles from frames."""

import numpy as np
import pytest
from films import COLORS, film, make_poses
from robot_dataset import draw

from dynmap_rl.data.flow import flow_velocity
from dynmap_rl.data.tracking import fill_gaps, track_centroid, track_objects

SIZE = 96


def truth(poses):
    return poses * [SIZE, SIZE, 1] - [0.5, 0.5, 0]


def test_a_square_is_found_to_half_a_pixel_though_it_rests_for_most_of_the_time():
    way = np.linspace(0.2, 0.8, 40)
    positions = np.stack([np.concatenate([way, np.full(100, 0.8)]), np.full(140, 0.5)], 1)
    track, _ = track_centroid(np.stack([draw(p) for p in positions]))
    error = np.abs(track[:, 0] - (positions[:, 0] * 128 - 0.5))
    assert error[5:35].max() < 1.5  # where it neither starts nor ends, in the background
    assert np.median(error) < 1.5


def test_specks_are_left_out_of_a_centroid():
    positions = np.stack([np.linspace(0.2, 0.8, 40), np.full(40, 0.5)], 1)
    frames = np.stack([draw(p) for p in positions])
    specked = frames.copy()
    rng = np.random.default_rng(0)
    for frame in specked:  # in the upper rows, which the square does not reach
        frame[rng.integers(0, 20, 30), rng.integers(0, 128, 30)] = 0
    np.testing.assert_allclose(track_centroid(specked)[0], track_centroid(frames)[0], atol=0.1)


def test_a_thing_smaller_than_a_speck_is_said_to_be_small():
    frames = np.full((40, 32, 96, 3), 200, np.uint8)
    for t, frame in enumerate(frames):
        frame[12:14, 2 * t : 2 * t + 2] = 0
    with pytest.raises(ValueError, match="speck"):
        track_centroid(frames)


def test_pixels_of_a_centroid_weigh_by_their_difference():
    frames = np.full((41, 32, 96, 3), 200, np.uint8)
    for t, frame in enumerate(frames):  # a dark square and, right of it, its light shadow
        frame[12:20, 2 * t : 2 * t + 4], frame[12:20, 2 * t + 4 : 2 * t + 8] = 50, 150
    centroid, _ = track_centroid(frames)
    np.testing.assert_allclose(centroid[10:30, 0], 2 * np.arange(10, 30) + 1.5 + 4 / 4, atol=0.01)


@pytest.mark.parametrize("noise", [0.0, 6.0])
@pytest.mark.parametrize("extent", [0.5, 0.15])
def test_objects_are_found_with_their_angles_also_where_they_rest(extent, noise):
    """With a motion that is shorter than the lying bar, whose middle is never seen without it."""
    poses = make_poses(extent=extent)
    tracks = track_objects(film(poses, SIZE, noise=noise), 2)
    assert tracks.found.all() and not tracks.cut.any()
    error = tracks.pose - truth(poses) - [[0, 0, 0], [0, 0, np.pi / 2]]  # the second object stands
    error[..., 2] -= np.pi * np.round(error[..., 2] / np.pi)  # axes have no direction
    error = np.abs(error)
    assert error[..., :2].max() < 1.5 and error[..., :2].mean() < 0.5
    assert error[..., 2].mean() < 0.05
    assert (tracks.elongation > 1.5).all()


def test_velocities_by_flow_are_those_of_the_motion():
    poses = make_poses(120)
    frames = film(poses, SIZE)
    time = np.cumsum(np.tile([0.04, 0.06], 60))  # uneven
    velocity = flow_velocity(frames, track_objects(frames, 2), time)
    expected = np.gradient(truth(poses), time, axis=0)
    for n in range(2):
        assert np.corrcoef(velocity[:, n, 0], expected[:, n, 0])[0, 1] > 0.9
        assert np.corrcoef(velocity[:, n, 2], expected[:, n, 2])[0, 1] > 0.2
    assert np.abs(velocity - expected)[..., :2].mean() < 0.4 * np.abs(expected[..., :2]).mean()


def test_velocities_by_flow_do_not_read_a_second_region_of_the_colour():
    poses = make_poses(40)
    alone = film(poses, SIZE)
    both = alone.copy()
    for t, frame in enumerate(both):  # a smaller square that moves up
        frame[60 - t : 68 - t, 84:92] = COLORS[1]
    tracks = [track_objects(frames, colors=[COLORS[1]]) for frames in (alone, both)]
    assert np.array_equal(tracks[0].labels, tracks[1].labels)
    np.testing.assert_allclose(
        *(flow_velocity(f, t, np.arange(len(f))) for f, t in zip((alone, both), tracks, strict=True)),
        atol=0.1,
    )


def test_an_object_that_is_hidden_is_interpolated():
    poses = make_poses()
    frames = film(poses, SIZE)
    hidden = slice(20, 25)
    frames[hidden] = film(poses[hidden], SIZE, bodies=[0])
    x, y = truth(poses)[22, 1, :2].astype(int)
    frames[hidden, y : y + 3, x : x + 3] = COLORS[1]  # a rest of it is seen
    tracks = track_objects(frames, 2)
    assert tracks.found[:, 0].all() and np.flatnonzero(~tracks.found[:, 1]).tolist() == list(range(20, 25))
    assert not tracks.area[hidden, 1].any()
    assert np.abs(tracks.pose - truth(poses))[hidden, :, :2].max() < 3
    velocity = flow_velocity(frames, tracks, np.arange(len(frames)))[:, 1]
    np.testing.assert_allclose(np.diff(velocity[20:25], 2, axis=0), 0, atol=1e-9)
    assert velocity[20:25, 0].min() > 0.1


def test_an_object_that_leaves_for_most_of_the_film_is_still_an_object():
    poses = make_poses()
    frames = np.concatenate([film(poses[:24], SIZE), film(poses[24:], SIZE, bodies=[0])])
    tracks = track_objects(frames, 2)
    assert tracks.found[:, 0].all() and np.array_equal(tracks.found[:, 1], np.arange(60) < 24)


def test_the_order_of_the_objects_is_the_chosen_one():
    frames = film(make_poses(), SIZE, colors=((60, 20, 20), (120, 120, 200)))
    heights = {sort: track_objects(frames, 2, sort=sort).pose[0, :, 1] for sort in ("lowest", "brightest")}
    assert np.array_equal(heights["lowest"], heights["brightest"][::-1])
    labels = track_objects(frames, 2, sort="brightest").labels
    assert frames[labels == 1].mean() > frames[labels == 2].mean()
    area = np.median(track_objects(frames, 2, sort="largest").area, axis=0)
    assert area[0] > area[1]


def test_what_rests_is_no_object_though_it_has_the_colour():
    poses = make_poses()
    frames = film(poses, SIZE, bodies=[0])
    frames[:, :16, :16] = COLORS[0]  # larger than the object
    tracks = track_objects(frames)
    assert np.abs(tracks.pose[:, 0] - truth(poses)[:, 0])[:, :2].max() < 1.5


@pytest.mark.parametrize("n", [0, 1])
def test_an_object_is_found_by_its_colour_beside_another_that_moves(n):
    """Also where something at rest has the colour, and whatever the order of the colours is."""
    poses = make_poses()
    frames = film(poses, SIZE, noise=4.0)
    frames[:, :16, :16] = COLORS[n]
    tracks = track_objects(frames, colors=[COLORS[n]])
    assert tracks.found.all() and tracks.pose.shape == (60, 1, 3)
    assert np.abs(tracks.pose[:, 0] - truth(poses)[:, n])[:, :2].max() < 1.5
    both = track_objects(frames, colors=[COLORS[n], COLORS[1 - n]])
    assert np.array_equal(both.pose[:, :1], tracks.pose)


def test_an_object_of_a_given_colour_that_rests_is_found():
    poses = make_poses()
    poses[:, 1] = poses[0, 1]
    tracks = track_objects(film(poses, SIZE), colors=[COLORS[1]])
    assert tracks.found.all() and np.ptp(tracks.pose[..., :2], axis=0).max() < 1.5
    assert np.abs(tracks.pose[:, 0] - truth(poses)[:, 1])[:, :2].max() < 1.5


def test_a_colour_that_is_not_there_is_refused():
    with pytest.raises(ValueError, match="#00ff00 .*--threshold"):
        track_objects(film(make_poses(), SIZE), colors=[COLORS[0], (0, 255, 0)])


def test_gaps_are_filled_linearly_and_at_the_ends_with_the_nearest_value():
    values, found = np.array([[9.0], [1.0], [9.0], [3.0], [9.0]]), np.array([0, 1, 0, 1, 0], bool)
    assert fill_gaps(values, found)[:, 0].tolist() == [1, 1, 2, 3, 3]


@pytest.mark.parametrize(
    ("frames", "objects", "message"),
    [
        (np.stack([draw(np.array([0.5, 0.5]))] * 10), 1, "nothing moves"),
        (film(make_poses(), SIZE, bodies=[0]), 2, "2 objects .* fewer --objects"),
        (film(make_poses(), SIZE, background=lambda t: 40 + 3 * t), 1, "camera must stand still"),
    ],
)
def test_what_cannot_be_tracked_is_refused(frames, objects, message):
    with pytest.raises(ValueError, match=message):
        track_objects(frames, objects)
    if message == "nothing moves":
        with pytest.raises(ValueError, match=message):
            track_centroid(frames)
