"""Trajectory errors: known offsets, scales and turns, a plain numpy computation, and sequences that are too short."""

from __future__ import annotations

import math
import re
from pathlib import Path

import numpy as np
import pytest
import torch
from evo.core.metrics import APE, RPE, PoseRelation, StatisticsType
from evo.core.trajectory import PosePath3D
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from lightning_pose.errors import ConfigError, DataError
from lightning_pose.metrics.trajectory import drift_by_length, mean_over_sequences, trajectory_errors

METRES = ["ate_rmse_m", "ate_origin_rmse_m", "rpe_rmse_m"]
Poses = tuple[np.ndarray, np.ndarray]


def walk(n: int = 40, seed: int = 0) -> Poses:
    """A smooth path in all directions: positions (n, 3), quaternions (n, 4)."""
    rng = np.random.default_rng(seed)
    turns = Rotation.from_rotvec(np.cumsum(rng.normal(0, 0.05, (n, 3)), axis=0))
    return np.cumsum(rng.normal(0.02, 0.05, (n, 3)), axis=0), turns.as_quat(scalar_first=True)


def moved(poses: Poses, turn: Rotation, shift: list[float]) -> Poses:
    """The same poses in another world."""
    return turn.apply(poses[0]) + shift, (turn * rotation(poses[1])).as_quat(scalar_first=True)


def rotation(quat_wxyz: np.ndarray) -> Rotation:
    return Rotation.from_quat(quat_wxyz, scalar_first=True)


def straight(n: int, metres: float, degrees: float = 0.0) -> Poses:
    """Steps of so many metres along x, and turns of so many degrees about x: the position stays on the axis."""
    i = np.arange(n)
    quat = Rotation.from_rotvec(np.deg2rad(degrees) * np.outer(i, [1, 0, 0])).as_quat(scalar_first=True)
    return np.stack([metres * i, 0 * i, 0 * i], axis=1), quat


def noisy(poses: Poses, seed: int = 1) -> Poses:
    rng = np.random.default_rng(seed)
    turns = rotation(poses[1]) * Rotation.from_rotvec(rng.normal(0, 0.02, (len(poses[0]), 3)))
    return poses[0] + rng.normal(0, 0.03, poses[0].shape), turns.as_quat(scalar_first=True)


def rms(errors: np.ndarray) -> float:
    return math.sqrt(np.mean(errors**2))


def by_hand(hat: Poses, truth: Poses) -> dict[str, float]:
    """The four metrics from 4x4 matrices and scipy's alignment."""
    T_hat, T = (np.tile(np.eye(4), (len(p), 1, 1)) for p, _ in (hat, truth))
    for matrices, (p, q) in ((T_hat, hat), (T, truth)):
        matrices[:, :3, :3], matrices[:, :3, 3] = rotation(q).as_matrix(), p
    x, y = hat[0] - hat[0].mean(axis=0), truth[0] - truth[0].mean(axis=0)
    best = Rotation.align_vectors(y, x)[0]
    anchored = T[0] @ np.linalg.inv(T_hat[0]) @ T_hat
    step = np.linalg.inv(T[:-1]) @ T[1:]
    error = np.linalg.inv(step) @ np.linalg.inv(T_hat[:-1]) @ T_hat[1:]
    return {
        "ate_rmse_m": rms(np.linalg.norm(best.apply(x) - y, axis=1)),
        "ate_origin_rmse_m": rms(np.linalg.norm((anchored - T)[:, :3, 3], axis=1)),
        "rpe_rmse_m": rms(np.linalg.norm(error[:, :3, 3], axis=1)),
        "rpe_rmse_deg": rms(np.rad2deg(Rotation.from_matrix(error[:, :3, :3]).magnitude())),
    }


@pytest.mark.parametrize("seed", range(4))
def test_errors_are_those_computed_by_hand(seed: int) -> None:
    truth = walk(30 + seed, seed)
    hat = noisy(moved(truth, Rotation.from_rotvec([0.4, -1.0, 2.0]), [3, -2, 9]), seed + 10)
    expected = by_hand(hat, truth)
    errors = trajectory_errors(*hat, *truth)
    assert list(errors) == list(expected)
    assert min(errors.values()) > 0.01
    assert errors == pytest.approx(expected, rel=1e-9)


def test_another_world_is_no_error() -> None:
    truth = walk()
    errors = trajectory_errors(*moved(truth, Rotation.from_rotvec([0.4, -1.0, 2.0]), [3, -2, 9]), *truth)
    assert max(errors.values()) < 1e-6


def test_the_sign_and_length_of_quaternions_and_the_kind_of_array_do_not_matter() -> None:
    truth, hat = walk(), noisy(walk())
    other = torch.from_numpy(hat[0]).requires_grad_(), torch.from_numpy(-3 * hat[1])
    assert trajectory_errors(*other, *truth) == pytest.approx(trajectory_errors(*hat, *truth))
    assert_allclose([*drift_by_length(*other, *truth, [3])], [*drift_by_length(*hat, *truth, [3])])


def test_inputs_are_left_as_they_were() -> None:
    truth, hat = walk(), noisy(walk())
    before = [part.copy() for part in hat + truth]
    trajectory_errors(*hat, *truth)
    for part, copy in zip(hat + truth, before, strict=True):
        assert_allclose(part, copy, rtol=0, atol=0)


def test_a_first_pose_in_error_counts_from_the_origin_alone() -> None:
    truth = straight(11, 1.0)
    quat = truth[1].copy()
    quat[0] = Rotation.from_euler("z", 60, degrees=True).as_quat(scalar_first=True)
    errors = trajectory_errors(truth[0], quat, *truth)
    assert errors["ate_rmse_m"] == pytest.approx(0, abs=1e-9)
    assert errors["ate_origin_rmse_m"] == pytest.approx(rms(np.arange(11)))  # chords of 60 degrees: as long as the arms


def test_drift_along_a_line_which_evo_cannot_align() -> None:
    """A tenth too far and half a degree too much each step: the best alignment centres one line on the other."""
    errors = trajectory_errors(*straight(21, 0.11, 1.5), *straight(21, 0.10, 1.0))
    i = 0.01 * np.arange(21)
    assert errors == pytest.approx(
        {"ate_rmse_m": i.std(), "ate_origin_rmse_m": rms(i), "rpe_rmse_m": 0.01, "rpe_rmse_deg": 0.5}
    )


def test_a_line_in_another_world_is_no_error() -> None:
    truth = straight(9, 0.2, 3.0)
    errors = trajectory_errors(*moved(truth, Rotation.from_rotvec([0.4, -1.0, 2.0]), [3, -2, 9]), *truth)
    assert max(errors.values()) < 1e-6


def test_a_line_and_one_barely_bent_have_one_error() -> None:
    """`evo` refuses the first and aligns the second."""
    truth, hat = straight(9, 0.2), straight(9, -0.3)
    bent = hat[0] + np.where(np.arange(9) == 4, 1e-6, 0.0)[:, None] * [0, 1, 0], hat[1]
    bent_truth = truth[0] + np.where(np.arange(9) == 2, 1e-6, 0.0)[:, None] * [0, 0, 1], truth[1]
    straightened = trajectory_errors(*hat, *truth)["ate_rmse_m"]
    assert straightened == pytest.approx(0.1 * np.arange(9).std())
    assert trajectory_errors(*bent, *bent_truth)["ate_rmse_m"] == pytest.approx(straightened, abs=1e-5)


def test_standing_still_has_the_spread_of_the_truth_and_a_mirror_is_no_rotation() -> None:
    truth = walk()
    still = np.zeros((40, 3)), np.tile([1.0, 0, 0, 0], (40, 1))
    spread = rms(np.linalg.norm(truth[0] - truth[0].mean(axis=0), axis=1))
    assert trajectory_errors(*still, *truth)["ate_rmse_m"] == pytest.approx(spread)
    assert trajectory_errors(*truth, *still)["ate_rmse_m"] == pytest.approx(spread)
    assert max(trajectory_errors(*still, *still).values()) == 0
    assert trajectory_errors(truth[0] * [1, 1, -1], truth[1], *truth)["ate_rmse_m"] > 0.05


@pytest.mark.parametrize("n", [0, 1, 2])
def test_too_few_poses_give_nan(n: int) -> None:
    truth, hat = walk(n), noisy(walk(n))
    errors = trajectory_errors(*hat, *truth)
    measured = {name for name, value in errors.items() if not math.isnan(value)}
    assert measured == (set(errors) - {"ate_rmse_m"} if n == 2 else set())


def test_a_lost_prediction_is_infinitely_wrong() -> None:
    truth, (position, quat) = walk(), noisy(walk())
    position[7] = np.nan
    assert set(trajectory_errors(position, quat, *truth).values()) == {math.inf}
    drift = drift_by_length(position, quat, *truth, [1, 35])
    assert np.isfinite(drift.position_m[0])
    assert_allclose(drift.starts, [39, 5])
    quat[20:] = np.inf
    assert drift_by_length(position, quat, *truth, [35]).orientation_deg == math.inf


def test_mistakes_are_refused() -> None:
    truth = walk()
    with pytest.raises(ConfigError, match=r"\(39, 3\).* give \(M, 3\)"):
        trajectory_errors(truth[0][1:], truth[1], *truth)
    broken = truth[0].copy()
    broken[[5, 8]] = np.nan
    with pytest.raises(DataError, match="2 true poses are not finite, the first in row 5; leave those frames out"):
        trajectory_errors(*truth, broken, truth[1])
    with pytest.raises(ConfigError, match="lengths has 0"):
        drift_by_length(*truth, *truth, [5, 0])


def test_each_sequence_counts_once_in_the_mean() -> None:
    per_sequence = {
        "long": {"ate_rmse_m": 1.0, "rpe_rmse_m": 4.0, "rpe_rmse_deg": math.nan},
        "lost": {"ate_rmse_m": 3.0, "rpe_rmse_m": math.inf, "rpe_rmse_deg": math.nan},
        "short": {"ate_rmse_m": math.nan, "rpe_rmse_m": 0.0},
    }
    means = mean_over_sequences(per_sequence)
    assert means == pytest.approx({"ate_rmse_m": 2.0, "rpe_rmse_m": math.inf, "rpe_rmse_deg": math.nan}, nan_ok=True)
    assert mean_over_sequences({}) == {}


def test_drift_grows_with_length_by_the_error_of_each_step() -> None:
    drift = drift_by_length(*straight(21, 0.11, 1.5), *straight(21, 0.10, 1.0), [1, 5, 20, 21])
    assert_allclose(drift.lengths, [1, 5, 20, 21])
    assert_allclose(drift.position_m, [0.01, 0.05, 0.2, math.nan])
    assert_allclose(drift.orientation_deg, [0.5, 2.5, 10, math.nan])
    assert_allclose(drift.percent, [10, 10, 10, math.nan])
    assert_allclose(drift.starts, [20, 16, 1, 0])


def test_drift_is_that_of_the_relative_poses() -> None:
    truth = walk()
    hat = noisy(moved(truth, Rotation.from_rotvec([0.4, -1.0, 2.0]), [3, -2, 9]))
    errors = []
    for i in range(40 - 7):
        here, there = rotation(truth[1][i]), rotation(hat[1][i])
        step = here.inv().apply(truth[0][i + 7] - truth[0][i]) - there.inv().apply(hat[0][i + 7] - hat[0][i])
        turn = (here.inv() * rotation(truth[1][i + 7])).inv() * there.inv() * rotation(hat[1][i + 7])
        distance = np.linalg.norm(np.diff(truth[0][i : i + 8], axis=0), axis=1).sum()
        metres = np.linalg.norm(step)
        errors.append([metres, np.rad2deg(turn.magnitude()), 100 * metres / distance])
    drift = drift_by_length(*hat, *truth, [7])
    medians = np.concatenate([drift.position_m, drift.orientation_deg, drift.percent])
    assert_allclose(medians, np.median(errors, axis=0), rtol=1e-9)


def test_percent_is_over_what_moved() -> None:
    position, quat = straight(9, 1.0)
    position[:5] = position[4]
    drift = drift_by_length(1.2 * position, quat, position, quat, [1, 2])
    assert_allclose(drift.percent, [20, 20])
    assert_allclose(drift.starts, [8, 7])
    still = drift_by_length(position, quat, 0 * position, quat, [1])
    assert math.isnan(still.percent[0])
    assert drift_by_length(position, quat, position, quat, []).lengths.shape == (0,)


@pytest.mark.parametrize("seed", range(5))
def test_errors_are_those_of_evo(seed: int) -> None:
    """evo is GPL-3: tests compare with it, and the package never imports it."""
    truth = walk(n=30 + seed, seed=seed)
    hat = moved(noisy(truth, seed + 10), Rotation.from_rotvec([0.3, -0.5, 1.0]), [3.0, -2.0, 7.0])
    reference, shape, anchored = (PosePath3D(*poses) for poses in (truth, hat, hat))
    shape.align(reference)
    anchored.align_origin(reference)
    measures = {
        "ate_rmse_m": (APE(PoseRelation.translation_part), shape),
        "ate_origin_rmse_m": (APE(PoseRelation.translation_part), anchored),
        "rpe_rmse_m": (RPE(PoseRelation.translation_part, delta=1), anchored),
        "rpe_rmse_deg": (RPE(PoseRelation.rotation_angle_deg, delta=1), anchored),
    }
    errors = trajectory_errors(*hat, *truth)
    for name, (metric, path) in measures.items():
        metric.process_data((reference, path))
        assert_allclose(errors[name], metric.get_statistic(StatisticsType.rmse), rtol=1e-7, err_msg=name)


def test_no_module_of_the_package_imports_evo() -> None:
    package = Path(__file__).parents[2] / "lightning_pose"
    assert [
        file.name for file in package.rglob("*.py") if re.search(r"^\s*(import|from) evo\b", file.read_text(), re.M)
    ] == []
