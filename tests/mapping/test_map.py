"""A map of known points: what is built of it, where images are located in it, and what it refuses."""

from __future__ import annotations

from dataclasses import fields, replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from lightning_pose.geometry.absolute_pose import CameraPose
from lightning_pose.mapping.build_map import add_frames, build_point_map, map_frames, summarize_tracks
from lightning_pose.mapping.calibration import calibrate_map, measure_frames
from lightning_pose.mapping.frames import MapFrames, MapQuery
from lightning_pose.mapping.given_poses import GivenPoses
from lightning_pose.mapping.map_localizer import MapLocalizer
from tests.mapping.helpers import make_frames, make_walk


@pytest.fixture(scope="module")
def training() -> MapFrames:
    return make_frames(*make_walk(60))


@pytest.fixture(scope="module")
def test() -> MapFrames:
    """Frames of the same wall, from places between the training frames."""
    rotation, position_m = make_walk(23, seed=5)
    turn = Rotation.from_euler("y", 3, degrees=True).as_matrix()
    return make_frames(rotation @ turn, position_m + np.array([0.02, 0.03, -0.05]), seed=1)


@pytest.fixture(scope="module")
def localizer(training: MapFrames) -> MapLocalizer:
    return MapLocalizer(build_point_map(training))


def test_most_points_of_the_wall_are_in_the_map(localizer: MapLocalizer) -> None:
    assert 300 <= len(localizer.map) <= 410


def test_new_images_are_located_to_millimetres(localizer: MapLocalizer, test: MapFrames) -> None:
    found = measure_frames(localizer, test)
    assert found.accepted.all()
    assert np.median(found.position) < 0.003
    assert found.position.max() < 0.01
    assert found.orientation_deg.max() < 0.2


@pytest.mark.parametrize(("scale", "origin"), [(1000.0, 0.0), (0.001, 0.0), (1.0, 5000.0)])
def test_no_threshold_depends_on_the_unit_or_the_origin(test: MapFrames, scale: float, origin: float) -> None:
    shift = np.full(3, origin)
    training = make_frames(*make_walk(30), scale=scale, origin=shift)
    moved = replace(test, position=test.position * scale + shift)
    found = measure_frames(MapLocalizer(build_point_map(training)), moved)
    assert found.accepted.all()
    assert np.median(found.position) < 0.003 * scale


def test_the_map_is_the_same_bit_for_bit_whatever_the_threads() -> None:
    training = make_frames(*make_walk(20))
    threads = torch.get_num_threads()
    try:
        maps = []
        for count in (1, 3):
            torch.set_num_threads(count)
            maps.append(build_point_map(training, adjust=True))
    finally:
        torch.set_num_threads(threads)
    for field in fields(maps[0]):
        np.testing.assert_array_equal(getattr(maps[0], field.name), getattr(maps[1], field.name), err_msg=field.name)


def test_an_image_of_another_place_is_refused_with_the_reason(localizer: MapLocalizer, test: MapFrames) -> None:
    rng = np.random.default_rng(3)
    looks = rng.normal(size=(100, 32))
    elsewhere = replace(test.query(0), points=rng.uniform(-0.4, 0.4, (100, 2)), size_px=np.full(100, 20.0))
    elsewhere = replace(elsewhere, descriptors=(looks / np.linalg.norm(looks, axis=1, keepdims=True)).astype("f4"))
    answer = localizer.locate(elsewhere)
    assert not answer.accepted
    assert "too few" in answer.reason or "weak geometry" in answer.reason
    assert answer.position_sd == np.inf


def test_an_image_without_keypoints_is_refused_at_a_training_pose(
    localizer: MapLocalizer, training: MapFrames, test: MapFrames
) -> None:
    query = test.query(0)
    blank = MapQuery(query.points[:0], query.size_px[:0], query.descriptors[:0], query.focal_px, query.half_view)
    answer = localizer.locate(blank)
    assert answer.reason == "too few features: 0"
    assert (np.abs(training.position - answer.pose.position).sum(axis=1) == 0).any()


def test_a_prior_locates_what_looks_too_different(localizer: MapLocalizer, test: MapFrames) -> None:
    """Descriptors so far from the map's that only those near their expected places are told apart."""
    query, truth = test.query(5), CameraPose(test.rotation[5], test.position[5])
    noise = np.random.default_rng(0).normal(0, 1, query.descriptors.shape)
    noise /= np.linalg.norm(noise, axis=1, keepdims=True)
    helped = []
    for share in np.arange(1.0, 1.2, 0.05):
        mixed = query.descriptors + share * noise
        changed = replace(query, descriptors=(mixed / np.linalg.norm(mixed, axis=1, keepdims=True)).astype(np.float32))
        if not localizer.locate(changed).accepted:
            answer = localizer.locate(changed, truth)
            if answer.accepted:
                helped.append(np.linalg.norm(answer.pose.position - truth.position))
    assert helped
    assert max(helped) < 0.05


def test_half_the_keypoints_wrong_still_locates(localizer: MapLocalizer, test: MapFrames) -> None:
    rng = np.random.default_rng(4)
    query = test.query(7)
    points = query.points.copy()
    wrong = rng.permutation(len(points))[: len(points) // 2]
    points[wrong] = rng.uniform(-0.6, 0.6, (len(wrong), 2))
    answer = localizer.locate(replace(query, points=points))
    assert answer.accepted
    assert np.linalg.norm(answer.pose.position - test.position[7]) < 0.02


def test_few_inliers_are_not_enough_if_they_are_a_small_share_or_leave_the_pose_open(
    localizer: MapLocalizer, test: MapFrames
) -> None:
    known = localizer.locate(test.query(7))
    judge = localizer._judge  # pyright: ignore[reportPrivateUsage]
    assert judge(25, 1000, known.position_sd, known.orientation_sd_deg) == ""
    assert judge(25, 1700, known.position_sd, known.orientation_sd_deg).startswith("too few guided inliers: 25 of 1700")
    assert judge(25, 1000, 1.0, known.orientation_sd_deg).startswith("weak geometry: standard deviations of 0.27")
    assert judge(40, 4000, 1.0, 2.0) == ""


def test_a_point_seen_under_a_wide_angle_has_the_smaller_covariance(localizer: MapLocalizer) -> None:
    point_map = localizer.map
    narrow, wide = (
        replace(
            point_map,
            points=np.array([[0.0, 0, 2]]),
            seen_point=np.zeros(2, np.int32),
            seen_count=np.array([1, 1], np.int32),
            position=np.array([[-x, 0, 0], [x, 0, 0]]),
            direction=point_map.direction[:1],
            log_size=point_map.log_size[:1],
            descriptors=point_map.descriptors[:1],
        ).measure_covariances()[0]
        for x in (0.1, 1.0)
    )
    # Two rays of length about 2 across which a place is known to 2, each: across both, to 2 / sqrt(2).
    np.testing.assert_allclose(np.diag(narrow)[:2], 2, rtol=0.02)
    assert narrow[2, 2] > 50 * wide[2, 2]


def test_a_radius_holds_nine_errors_of_ten() -> None:
    training = make_frames(*make_walk(90), noise_px=0.8)
    rotation, position_m = make_walk(60, seed=8)
    test = make_frames(rotation, position_m + np.array([0.01, -0.03, 0.04]), noise_px=0.8, seed=9)
    mapped = map_frames(training, adjust=False)
    calibration = calibrate_map(mapped)
    found = measure_frames(MapLocalizer(summarize_tracks(mapped)), test)
    for error, spread, factor in (
        (found.position, found.position_sd, calibration.position_factor),
        (found.orientation_deg, found.orientation_sd_deg, calibration.orientation_factor),
    ):
        assert 0.75 <= (error <= spread * factor).mean() <= 1.0
    assert calibration.accepted == 1.0


def test_adjusted_poses_are_nearer_the_truth_and_answers_are_carried_back() -> None:
    rng = np.random.default_rng(0)
    rotation, position_m = make_walk(80)
    true = make_frames(rotation, position_m)
    # Given poses drift smoothly by up to 4 cm, as those of real datasets do.
    drift = np.column_stack([0.03 * np.sin(np.linspace(0, 9, 80)), 0.02 * np.cos(np.linspace(0, 7, 80)), np.zeros(80)])
    noise = Rotation.from_rotvec(rng.normal(0, 0.002, (80, 3))).as_matrix()
    given = true.with_poses(rotation @ noise, position_m + drift + rng.normal(0, 0.002, (80, 3)))
    every = np.arange(80)
    held = every[5::10]
    kept = np.setdiff1d(every, held)
    plain, adjusted = (
        measure_frames(MapLocalizer(build_point_map(given.select(kept), adjust)), given.select(held))
        for adjust in (False, True)
    )
    assert np.median(adjusted.position) < 0.75 * np.median(plain.position)


def test_carrying_back_returns_what_the_dataset_gives(training: MapFrames) -> None:
    point_map = build_point_map(training)
    turn = Rotation.from_rotvec([0.0, 0.02, 0.01]).as_matrix()
    shifted = replace(
        point_map,
        given_rotation=point_map.rotation @ turn,
        given_position=point_map.position + point_map.rotation @ [0.01, 0.0, 0.03],
    )
    pose = CameraPose(point_map.rotation[20], point_map.position[20])
    carried = GivenPoses(shifted).carry_back(pose)
    np.testing.assert_allclose(carried.rotation, shifted.given_rotation[20], atol=1e-9)
    np.testing.assert_allclose(carried.position, shifted.given_position[20], atol=1e-9)
    there = GivenPoses(shifted).carry_forward(carried)
    np.testing.assert_allclose(there.rotation, pose.rotation, atol=1e-9)
    np.testing.assert_allclose(there.position, pose.position, atol=1e-9)


def test_an_offset_of_the_clocks_is_carried_back_by_how_the_camera_turns(training: MapFrames) -> None:
    point_map = replace(build_point_map(training), camera=np.array([1.0, 0, 0, 0, 0.5]))
    turns = point_map.turns
    late = replace(point_map, given_rotation=point_map.rotation @ Rotation.from_rotvec(0.4 * turns).as_matrix())
    pose, turn = CameraPose(point_map.rotation[20], point_map.position[20]), np.array([0.02, -0.03, 0.01])
    carried = GivenPoses(late).carry_back(pose, turn)
    still = GivenPoses(late).carry_back(pose)
    np.testing.assert_allclose(
        Rotation.from_matrix(still.rotation.T @ carried.rotation).as_rotvec(), 0.4 * turn, atol=1e-3
    )


def test_a_map_of_an_older_file_has_a_global_shutter(training: MapFrames) -> None:
    point_map = build_point_map(training)
    assert not replace(point_map, camera=point_map.camera[:4]).turns.any()


def test_added_frames_stand_where_a_new_adjustment_would_put_them(training: MapFrames) -> None:
    rng = np.random.default_rng(0)
    given = training.with_poses(training.rotation, training.position + rng.normal(0, 0.01, (60, 3)))
    rows = np.setdiff1d(np.arange(60), np.arange(4, 60, 6))
    old = map_frames(given.select(rows), adjust=True)
    new = given.select(np.arange(4, 60, 6))
    localizer = MapLocalizer(summarize_tracks(old))
    grown = add_frames(old, given, rows, [localizer.locate(new.query(i)).pose_in_map for i in range(len(new))])
    assert len(grown.seen) == 60
    error, given_error = (np.linalg.norm(np.diff(frames.position - training.position, axis=0), axis=1)
                          for frames in (grown.seen, given))  # fmt: skip
    assert np.median(error) < 0.3 * np.median(given_error)


def test_frames_are_added_to_adjusted_maps_alone(training: MapFrames) -> None:
    plain = map_frames(training.select(np.arange(20)), adjust=False)
    with pytest.raises(ValueError, match="after bundle adjustment"):
        add_frames(plain, training, np.arange(20), [])


def test_a_map_stays_small(localizer: MapLocalizer) -> None:
    assert localizer.map.descriptors.dtype == np.int8
    assert localizer.map.n_bytes < 200_000
