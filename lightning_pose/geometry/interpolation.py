"""Poses between the times of a trajectory: positions on straight lines, rotations at constant speed (slerp)."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

__all__ = ["interpolate_poses"]


def interpolate_poses(
    times_s: Float[np.ndarray, " n"],
    positions_m: Float[np.ndarray, "n 3"],
    quats_wxyz: Float[np.ndarray, "n 4"],
    at_s: Float[np.ndarray, " m"],
    max_gap_s: float = np.inf,
) -> tuple[Float[np.ndarray, "m 3"], Float[np.ndarray, "m 4"]]:
    """The poses of a trajectory at other times: the straight line and the shortest rotation between two of its poses.

    Shoemake, "Animating rotation with quaternion curves", SIGGRAPH 1985.

    Args:
        times_s: of the poses, in any order; of several poses of one time the first is used, and those with a value
            that is not finite are left out.
        positions_m: camera centres.
        quats_wxyz: unit quaternions.
        at_s: when poses are wanted, in the unit of `times_s`.
        max_gap_s: a longer time between two poses is a hole, in which there are no poses.

    Returns:
        positions and unit quaternions with w >= 0, float64; nan before the first pose, after the last, and in holes.

    >>> times, quats = np.array([0.0, 1.0]), np.array([[1.0, 0, 0, 0], [0, 0, 0, 1]])  # half a turn about z
    >>> position, quat = interpolate_poses(times, np.array([[0.0, 0, 0], [4, 0, 0]]), quats, np.array([0.5, 2]))
    >>> print(position[0], quat[0].round(3), position[1])
    [2. 0. 0.] [0.707 0.    0.    0.707] [nan nan nan]
    """
    position, quat = np.full((len(at_s), 3), np.nan), np.full((len(at_s), 4), np.nan)
    usable = np.isfinite(times_s) & np.isfinite(positions_m).all(axis=1) & np.isfinite(quats_wxyz).all(axis=1)
    times, first = np.unique(times_s[usable], return_index=True)
    if not len(times):
        return position, quat
    positions, quats = positions_m[usable][first], quats_wxyz[usable][first]
    # The two poses around a time, which are one and the same where a pose has that time.
    after = np.searchsorted(times, at_s).clip(max=len(times) - 1)
    before = np.where(times[after] == at_s, after, np.maximum(after - 1, 0))
    inside = (times[before] <= at_s) & (at_s <= times[after]) & (times[after] - times[before] <= max_gap_s)
    before, after, at_s = before[inside], after[inside], at_s[inside]
    step_s = times[after] - times[before]
    part = np.divide(at_s - times[before], step_s, out=np.zeros(len(at_s)), where=step_s > 0)[:, None]
    position[inside] = positions[before] + part * (positions[after] - positions[before])
    if len(before):
        start, end = (Rotation.from_quat(quats[rows], scalar_first=True) for rows in (before, after))
        turn = Rotation.from_rotvec(part * (start.inv() * end).as_rotvec())
        quat[inside] = (start * turn).as_quat(canonical=True, scalar_first=True)
    return position, quat
