"""Which reading of a dataset's poses fits its images: the epipolar residual under each usual convention."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from lightning_pose.geometry.epipolar import essential_matrices, sampson_distances_px
from lightning_pose.mapping.frame_matches import FrameMatches

__all__ = ["AS_READ", "MATCHES_TO_RANK", "OUTLIER_PX", "Reading", "fit_focal_length", "rank_readings", "read_poses_as"]

FOCAL_RANGE = (0.4, 2.5)
"""Focal lengths that are tried, in widths of the image: 103 to 23 degrees of view."""

FOCAL_STEPS = 12
"""Focal lengths of the first round of a search: 18 % apart."""

OUTLIER_PX = 2.0
"""A match this far from its epipolar line counts half-way between an inlier and an outlier."""

MATCHES_TO_RANK = 2000
"""Matches on which all readings are compared; the best one and the files' own are then measured on all."""

AS_READ = "as read"

QUAT_SHIFTS = {"": 0, "quaternion order wxyz": -1, "quaternion order xyzw": 1}
"""Places by which a quaternion's four numbers move: read as xyzw though wxyz was written, or the other way round."""

CAMERA_AXES: Mapping[str, np.ndarray] = {
    "": np.eye(3),
    "OpenGL axes (y up, z backward)": np.diag([1.0, -1, -1]),
    "left-handed axes (y up)": np.diag([1.0, -1, 1]),
    "images turned by 180 degrees": np.diag([-1.0, -1, 1]),
    "images turned by 90 degrees clockwise": np.array([[0.0, 1, 0], [-1, 0, 0], [0, 0, 1]]),
    "images turned by 90 degrees counter-clockwise": np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]),
}
"""Axes of the files' camera in ours, column by column: x right, y down, z forward."""

POSE_FORMS = ("", "world-to-camera", "camera centre with a world-to-camera rotation")


@dataclass(frozen=True)
class Reading:
    """One way to read the pose files, and how well the images agree with it.

    Attributes:
        name: what the files hold, where that differs from how they were read; `AS_READ` for no difference.
        cost: mean over the matches of log(1 + (distance / 2 px)^2), which outliers hardly change.
        residual_px: median Sampson distance of the matches.
        focal_px: the focal length with the lowest cost, at which both are measured.
    """

    name: str
    cost: float
    residual_px: float
    focal_px: float


def read_poses_as(
    name: str, rotation: np.ndarray, position: np.ndarray, inverse_quats: bool = False
) -> tuple[np.ndarray, np.ndarray]:
    """The poses that the same files hold under another convention.

    Args:
        name: of a `Reading`.
        rotation: (F, 3, 3), camera-to-world rotations as read.
        position: (F, 3), camera centres as read.
        inverse_quats: whether the files' quaternions are world-to-camera, and were inverted when they were read.

    Returns:
        rotation (F, 3, 3) and position (F, 3), camera-to-world, OpenCV axes.

    Raises:
        KeyError: no reading has this name.
    """
    order, form, axes = dict(_name_readings())[name]
    if shift := QUAT_SHIFTS[order]:
        filed = np.swapaxes(rotation, -1, -2) if inverse_quats else rotation
        quats = np.roll(Rotation.from_matrix(filed).as_quat(scalar_first=True), shift, axis=1)
        filed = Rotation.from_quat(quats, scalar_first=True).as_matrix()
        rotation = np.swapaxes(filed, -1, -2) if inverse_quats else filed
    if form:
        rotation = np.swapaxes(rotation, -1, -2)
    if form == "world-to-camera":
        position = -np.einsum("fij,fj->fi", rotation, position)
    turn = CAMERA_AXES[axes]
    if np.linalg.det(turn) < 0:  # a left-handed camera stands in a left-handed world: both are reflected
        mirror = np.diag([1.0, -1, 1])
        return mirror @ rotation @ turn, position @ mirror
    return rotation @ turn, position


def rank_readings(
    matches: FrameMatches, rotation: np.ndarray, position: np.ndarray, width_px: float, inverse_quats: bool = False
) -> list[Reading]:
    """Every usual reading of the poses, best first; the files' own comes before others of equal cost.

    Every reading gets the focal length that suits it best, so that none needs the camera to be known.

    Args:
        matches: of frames that see the same things.
        rotation: (F, 3, 3), camera-to-world rotations as read.
        position: (F, 3), camera centres as read.
        width_px: the longer side of the images.
        inverse_quats: see `read_poses_as`.

    Returns:
        one `Reading` for each name; all costs are nan where no pair of frames has a baseline.
    """

    def measure(name: str, matches: FrameMatches, rounds: int) -> Reading:
        return Reading(
            name, *fit_focal_length(matches, *read_poses_as(name, rotation, position, inverse_quats), width_px, rounds)
        )

    few = matches.sample(MATCHES_TO_RANK)
    coarse = sorted((measure(name, few, rounds=1) for name, _ in _name_readings()), key=lambda reading: reading.cost)
    fine = {name: measure(name, matches, rounds=4) for name in (AS_READ, *(reading.name for reading in coarse[:3]))}
    return sorted((fine.get(reading.name, reading) for reading in coarse), key=lambda reading: reading.cost)


def fit_focal_length(
    matches: FrameMatches, rotation: np.ndarray, position: np.ndarray, width_px: float, rounds: int = 4
) -> tuple[float, float, float]:
    """The focal length under which the matches fit the poses best: a search along one line, finer in each round.

    Args:
        matches: of frames that see the same things.
        rotation: (F, 3, 3), camera-to-world rotations.
        position: (F, 3), camera centres.
        width_px: the longer side of the images.
        rounds: 1 for 18 % of the focal length, each more for a sixth of that.

    Returns:
        the lowest cost, the median Sampson distance there (pixels), and the focal length (pixels), as in `Reading`.
    """
    a, b = matches.frame_a, matches.frame_b
    essential = essential_matrices(rotation[a], position[a], rotation[b], position[b])[matches.pair]

    low, high = (width_px * bound for bound in FOCAL_RANGE)
    for steps in (FOCAL_STEPS, *[7] * (rounds - 1)):
        tried = np.geomspace(low, high, steps)
        distance = sampson_distances_px(essential, matches.points_a_px, matches.points_b_px, tried)
        distance = distance[:, np.isfinite(distance).all(axis=0)]
        if not distance.size:
            return np.nan, np.nan, float(low)
        costs = np.log1p((distance / OUTLIER_PX) ** 2).mean(axis=1)
        best = int(np.argmin(costs))
        low, high = tried[max(best - 1, 0)], tried[min(best + 1, steps - 1)]
    return float(costs[best]), float(np.median(distance[best])), float(tried[best])


def _name_readings() -> Iterator[tuple[str, tuple[str, str, str]]]:
    """Each reading's name, with the quaternion order, the form of the pose and the camera's axes that make it."""
    for order in QUAT_SHIFTS:
        for form in POSE_FORMS:
            for axes in CAMERA_AXES:
                yield ", ".join(part for part in (order, form, axes) if part) or AS_READ, (order, form, axes)
