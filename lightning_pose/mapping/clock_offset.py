"""Whether the clocks of images and poses agree: the epipolar residual of the poses at shifted times."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from lightning_pose.geometry.epipolar import essential_matrices, sampson_distances_px
from lightning_pose.geometry.interpolation import interpolate_poses
from lightning_pose.mapping.conventions import OUTLIER_PX
from lightning_pose.mapping.frame_matches import FrameMatches
from lightning_pose.scenes.pose_times import measure_hole
from lightning_pose.scenes.scene import Trajectory

__all__ = ["MAX_OFFSET_S", "STEP_S", "ClockOffset", "fit_clock_offset"]

MAX_OFFSET_S = 0.2
STEP_S = 0.01
"""Offsets that are tried first; then the best one's surroundings in steps of a tenth."""

MIN_PAIRS = 10


@dataclass(frozen=True)
class ClockOffset:
    """The offset between the clocks of images and poses that fits the images best.

    Attributes:
        offset_s: an image of time t has the pose of time t + offset_s.
        cost: there, as in `Reading`; of the same matches as `cost_at_zero`.
        residual_px: there, median Sampson distance.
        cost_at_zero: of the poses interpolated at the images' times as given.
        residual_at_zero_px: likewise.
    """

    offset_s: float
    cost: float
    residual_px: float
    cost_at_zero: float
    residual_at_zero_px: float


def fit_clock_offset(
    matches: FrameMatches,
    times_s: np.ndarray,
    trajectory: Trajectory,
    focal_px: float,
    max_offset_s: float = MAX_OFFSET_S,
    step_s: float = STEP_S,
) -> ClockOffset | None:
    """Search for the time shift of the poses under which matches lie nearest to their epipolar lines.

    Pairs of frames count only if they have poses at every offset that is tried.

    Args:
        matches: of frames that see the same things.
        times_s: (F,) of the frames.
        trajectory: the poses, whose time may be that of another clock.
        focal_px: focal length, in pixels of the matches.
        max_offset_s: offsets between minus this and this are tried.
        step_s: in this step first; then around the best one in tenths of it.

    Returns:
        None where fewer than `MIN_PAIRS` pairs have poses at every offset.
    """
    gap_s = measure_hole(trajectory)
    if gap_s == 0:
        return None

    def read_poses(offset_s: float) -> tuple[np.ndarray, np.ndarray]:
        position, quat = interpolate_poses(*trajectory, times_s + offset_s, gap_s)
        quat[np.isnan(quat).any(axis=1)] = [1, 0, 0, 0]
        return Rotation.from_quat(quat, scalar_first=True).as_matrix(), position

    count = round(max_offset_s / step_s)
    coarse = {k * step_s: read_poses(k * step_s) for k in range(-count, count + 1)}
    known = np.all([np.isfinite(position).all(axis=1) for _, position in coarse.values()], axis=0)
    usable = known[matches.frame_a] & known[matches.frame_b]
    if usable.sum() < MIN_PAIRS:
        return None
    kept = usable[matches.pair]
    pair, points_a, points_b = matches.pair[kept], matches.points_a_px[kept], matches.points_b_px[kept]

    def measure(offset_s: float) -> tuple[float, float]:
        rotation, position = coarse.get(offset_s) or read_poses(offset_s)
        a, b = matches.frame_a, matches.frame_b
        essential = essential_matrices(rotation[a], position[a], rotation[b], position[b])[pair]
        distance = sampson_distances_px(essential, points_a, points_b, focal_px)
        distance = distance[np.isfinite(distance)]
        if not len(distance):
            return np.inf, np.inf
        return float(np.log1p((distance / OUTLIER_PX) ** 2).mean()), float(np.median(distance))

    best = min(coarse, key=lambda offset_s: measure(offset_s)[0])
    best = min((best + k * step_s / 10 for k in range(-9, 10)), key=lambda offset_s: measure(offset_s)[0])
    return ClockOffset(best, *measure(best), *measure(0.0))
