"""Errors of a whole trajectory: absolute and relative pose error, and drift by length as in the KITTI benchmark."""

from __future__ import annotations

import math
import statistics
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from lightning_pose.errors import ConfigError, DataError
from lightning_pose.geometry.quaternions import (
    compose_pose,
    orientation_error_deg,
    position_error_m,
    quat_normalize,
    relative_pose,
)

__all__ = ["Drift", "drift_by_length", "mean_over_sequences", "trajectory_errors"]

Array = Tensor | np.ndarray
Poses = tuple[Tensor, Tensor]  # position_m (M, 3) and quat_wxyz (M, 4), float64 on the CPU

METRICS: tuple[str, ...] = ("ate_rmse_m", "ate_origin_rmse_m", "rpe_rmse_m", "rpe_rmse_deg")


class Drift(NamedTuple):
    """Errors at the end of sub-trajectories relative to their own start: arrays (L,), one value for each length.

    NaN if no sub-trajectory is that long, and in `percent` also if none of them moved.
    """

    lengths: np.ndarray
    """Steps from start to end: one less than the number of images in a clip."""
    position_m: np.ndarray
    """Median error of the end's position."""
    orientation_deg: np.ndarray
    """Median error of the end's orientation."""
    percent: np.ndarray
    """Median of 100 times position error divided by the true distance travelled, of those that moved."""
    starts: np.ndarray
    """How many sub-trajectories the medians are of: one for each start."""


def trajectory_errors(position_hat: Array, quat_hat: Array, position: Array, quat: Array) -> dict[str, float]:
    """Absolute and relative errors of one sequence's trajectory (Sturm et al., IROS 2012), defined as in `evo`.

    - `ate_rmse_m`: position error after the whole trajectory is aligned to the truth by the best rotation and
      translation, without scale (Umeyama, PAMI 1991): `evo_ape -a`. It measures the shape alone. If the best rotation
      is not unique (the camera moves on a line, or not at all), the error is the same for all of them.
    - `ate_origin_rmse_m`: position error after the first poses are aligned, `evo_ape --align_origin`: the drift.
    - `rpe_rmse_m`, `rpe_rmse_deg`: error of each step, from a row to the next: `evo_rpe --delta 1`.

    A metric is NaN if the sequence is too short for it: `ate_rmse_m` of fewer than three poses, which can be aligned
    with almost anything, and all four of fewer than two. A prediction with a pose that is not finite has infinite
    errors, so that it never counts as better than one that drifts.

    Args:
        position_hat: (M, 3) predicted camera centres, metres, in any world: they are aligned here.
        quat_hat: (M, 4) predicted, wxyz, camera-to-world; any length, normalised here.
        position: (M, 3) true.
        quat: (M, 4) true.

    Raises:
        ConfigError: shapes do not fit.
        DataError: a true pose is not finite.
    """
    hat, truth = _check_poses(position_hat, quat_hat, position, quat)
    n_poses = len(truth[0])
    if n_poses < 2:
        return dict.fromkeys(METRICS, math.nan)
    finite = all(bool(part.isfinite().all()) for part in hat)
    errors = _measure_errors(hat, truth) if finite else dict.fromkeys(METRICS, math.inf)
    return errors if n_poses > 2 else errors | {"ate_rmse_m": math.nan}


def mean_over_sequences(per_sequence: Mapping[str, Mapping[str, float]]) -> dict[str, float]:
    """Mean of each metric over sequences, each of the same weight, whatever its length.

    A sequence whose metric is NaN (it is too short) is left out of that metric's mean; the mean is NaN if all are left
    out. An infinite error makes the mean infinite.

    Args:
        per_sequence: sequence to metrics, as `trajectory_errors` returns them.
    """
    names = dict.fromkeys(name for metrics in per_sequence.values() for name in metrics)
    means = {}
    for name in names:
        values = [metrics[name] for metrics in per_sequence.values() if not math.isnan(metrics.get(name, math.nan))]
        means[name] = statistics.fmean(values) if values else math.nan
    return means


def drift_by_length(
    position_hat: Array, quat_hat: Array, position: Array, quat: Array, lengths: Sequence[int]
) -> Drift:
    """Errors at the end of sub-trajectories of given lengths, from every start.

    This is the drift of Geiger et al. (CVPR 2012), with lengths in frames instead of metres.

    Args:
        position_hat: (M, 3) predicted camera centres of one sequence, metres, in any world.
        quat_hat: (M, 4) predicted, wxyz, camera-to-world; any length, normalised here.
        position: (M, 3) true.
        quat: (M, 4) true.
        lengths: L numbers of steps, 1 or more: a clip of T images has T - 1.

    Returns:
        a `Drift`; a predicted pose that is not finite has infinite errors.

    Raises:
        ConfigError: shapes do not fit, or a length is below 1.
        DataError: a true pose is not finite.
    """
    if min(lengths, default=1) < 1:
        raise ConfigError(f"lengths has {min(lengths)}, but a sub-trajectory has one step at least; give 1 or more")
    hat, truth = _check_poses(position_hat, quat_hat, position, quat)
    rows = [_measure_drift(hat, truth, int(length)) for length in lengths]
    metres, degrees, percent, starts = np.array(rows, float).reshape(len(rows), 4).T
    return Drift(np.array(lengths, int), metres, degrees, percent, starts.astype(int))


def _check_poses(position_hat: Array, quat_hat: Array, position: Array, quat: Array) -> tuple[Poses, Poses]:
    """Predicted and true poses in float64 on the CPU, with unit quaternions; raise the errors of the callers."""
    parts = [torch.as_tensor(part).detach().cpu().double() for part in (position_hat, quat_hat, position, quat)]
    shapes = [tuple(part.shape) for part in parts]
    n_poses = shapes[2][0] if shapes[2] else 0
    if shapes != [(n_poses, 3), (n_poses, 4)] * 2:
        raise ConfigError(f"shapes of poses are {shapes}; give (M, 3), (M, 4), (M, 3), (M, 4) with one M")
    bad = (~torch.cat(parts[2:], dim=1).isfinite().all(dim=1)).nonzero().flatten()
    if len(bad):
        raise DataError(f"{len(bad)} true poses are not finite, the first in row {int(bad[0])}; leave those frames out")
    return (parts[0], quat_normalize(parts[1])), (parts[2], quat_normalize(parts[3]))


def _measure_errors(hat: Poses, truth: Poses) -> dict[str, float]:
    """The four metrics of two finite trajectories of at least two poses."""
    aligned = _align_positions(hat[0].numpy(), truth[0].numpy())
    start = compose_pose(truth[0][0], truth[1][0], *relative_pose(hat[0][0], hat[1][0], hat[0], hat[1]))[0]
    step_hat, step = (relative_pose(p[:-1], q[:-1], p[1:], q[1:]) for p, q in (hat, truth))
    return {
        "ate_rmse_m": _compute_rms(np.linalg.norm(aligned - truth[0].numpy(), axis=1)),
        "ate_origin_rmse_m": _compute_rms(position_error_m(start, truth[0]).numpy()),
        "rpe_rmse_m": _compute_rms(relative_pose(*step, *step_hat)[0].norm(dim=1).numpy()),
        "rpe_rmse_deg": _compute_rms(orientation_error_deg(step_hat[1], step[1]).numpy()),
    }


def _compute_rms(errors: np.ndarray) -> float:
    """Root mean square of errors."""
    return math.sqrt(np.mean(errors**2))


def _align_positions(points: np.ndarray, targets: np.ndarray) -> np.ndarray:
    """Points (M, 3) moved by the rotation and translation closest to the targets (Umeyama, PAMI 1991, without scale).

    If the best rotation is not unique (on a straight line, or if points or targets are all equal), one of the best is
    used: the sum of squares is the same for all. Aligning such a case by the translation alone would make the error of
    a nearly straight walk depend on the last digit of its coordinates.
    """
    centre, target = points.mean(axis=0), targets.mean(axis=0)
    left, _, right = np.linalg.svd((targets - target).T @ (points - centre))
    left[:, 2] *= np.sign(np.linalg.det(left) * np.linalg.det(right))  # a rotation, not a mirror
    return (points - centre) @ (left @ right).T + target


def _measure_drift(hat: Poses, truth: Poses, length: int) -> tuple[float, float, float, int]:
    """Medians in metres, degrees and percent over all starts, and how many starts there are."""
    count = len(truth[0]) - length
    if count < 1:
        return math.nan, math.nan, math.nan, 0
    moved_hat, moved = (relative_pose(p[:-length], q[:-length], p[length:], q[length:]) for p, q in (hat, truth))
    metres, degrees = position_error_m(moved_hat[0], moved[0]), orientation_error_deg(moved_hat[1], moved[1])
    metres, degrees = (errors.where(errors.isfinite(), math.inf).numpy() for errors in (metres, degrees))
    steps = position_error_m(truth[0][1:], truth[0][:-1])
    distance = steps.unfold(0, length, 1).sum(dim=1).numpy()
    travelled = distance > 0
    percent = np.median(100 * metres[travelled] / distance[travelled]) if travelled.any() else math.nan
    return float(np.median(metres)), float(np.median(degrees)), float(percent), count
