"""Checks the poses of a dataset: matrices and quaternions that are no pose get a fault in words."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from scipy.spatial.transform import Rotation

__all__ = ["check_matrices", "check_quats"]

MAX_SKEW = 2e-2
"""Largest entry of R^T R - 1 that is taken for a rounding error: two decimals give 0.017; 7-Scenes has up to 3e-4."""

MAX_POSITION = 1e12
"""A coordinate beyond this is no position in any unit: the Earth measures 4e10 mm around."""


def check_matrices(T_world_cam: np.ndarray) -> tuple[np.ndarray, np.ndarray, list[str]]:
    """Positions and quaternions of camera-to-world matrices, and what is wrong with each.

    A matrix that is a rotation except for rounding errors is replaced by the nearest rotation (SVD).

    Args:
        T_world_cam: (N, 4, 4).

    Returns:
        (N, 3) positions and (N, 4) unit quaternions wxyz with w >= 0, float64, and N faults. A fault is empty for a
        sound pose. Otherwise it is that an entry is not finite, that the last row is not 0 0 0 1, or that the
        rotation is scaled, skewed or mirrored.
    """
    unreadable = np.isfinite(T_world_cam).sum(axis=(1, 2)) < 16
    matrices = np.where(unreadable[:, None, None], np.eye(4), T_world_cam)
    R, position_m, bottom = matrices[:, :3, :3], matrices[:, :3, 3], matrices[:, 3]
    with np.errstate(over="ignore", invalid="ignore"):
        det = np.linalg.det(R)
        skew = np.abs(R.swapaxes(1, 2) @ R - np.eye(3)).max(axis=(1, 2))
    faults = _name_faults(
        [
            (unreadable, T_world_cam, "the pose has NaN or infinite entries ({}); remove the frame"),
            (
                np.abs(bottom - [0, 0, 0, 1]).max(axis=1) > 1e-6,
                bottom,
                "the last row is {}, not 0 0 0 1; give a 4x4 camera-to-world matrix",
            ),
            (det < 0, det, "the rotation is mirrored (determinant {}); give right-handed axes"),
            (~(skew <= MAX_SKEW), skew, "the 3x3 is no rotation (R^T R is off by {}); correct the pose"),
            _find_far(position_m),
        ],
        len(matrices),
    )
    U, _, Vt = np.linalg.svd(np.where(np.array([bool(fault) for fault in faults])[:, None, None], np.eye(3), R))
    return position_m, _make_canonical_quats(Rotation.from_matrix(U @ Vt)), faults


def check_quats(
    position_m: np.ndarray, quats: np.ndarray, scalar_first: bool
) -> tuple[np.ndarray, np.ndarray, list[str]]:
    """Positions and normalised quaternions of a file, and what is wrong with each.

    Args:
        position_m: (N, 3) as the file has them.
        quats: (N, 4) as the file has them.
        scalar_first: whether the file has wxyz; otherwise xyzw.

    Returns:
        (N, 3) positions and (N, 4) unit quaternions wxyz with w >= 0, float64, and N faults. A fault is empty for a
        sound pose. Otherwise it is that a number is not finite, or that a norm differs from 1 by more than 10 %, more
        than rounding errors can explain.
    """
    unreadable = np.isfinite(np.column_stack([position_m, quats])).sum(axis=1) < 7
    position_m = np.where(unreadable[:, None], 0.0, position_m)
    quats = np.where(unreadable[:, None], [1.0, 0, 0, 0], quats)
    with np.errstate(over="ignore"):
        norms = np.linalg.norm(quats, axis=1)
    off = ~(np.abs(norms - 1) <= 0.1)
    faults = _name_faults(
        [
            (unreadable, norms, "the pose has NaN or infinite numbers; correct the line"),
            (off, norms, "the quaternion's norm is {}, not 1; check the order of the columns"),
            _find_far(position_m),
        ],
        len(quats),
    )
    quats = np.where(off[:, None], [1.0, 0, 0, 0], quats)
    return position_m, _make_canonical_quats(Rotation.from_quat(quats, scalar_first=scalar_first)), faults


def _find_far(position_m: np.ndarray) -> tuple[np.ndarray, np.ndarray, str]:
    """The check for coordinates that are too large for a position."""
    return np.abs(position_m).max(axis=1) > MAX_POSITION, position_m, "the position is {}; correct the pose"


def _make_canonical_quats(rotation: Rotation) -> np.ndarray:
    """Quaternions wxyz with w >= 0: of q and -q, always the same one, whichever the file has."""
    return rotation.as_quat(canonical=True, scalar_first=True)


def _name_faults(checks: Iterable[tuple[np.ndarray, np.ndarray, str]], count: int) -> list[str]:
    """The first fault of each pose; of each check: which poses have the fault, their values, and the text."""
    faults = [""] * count
    for bad, values, text in checks:
        for i in np.flatnonzero(bad):
            value = np.array2string(values[i], precision=6).replace("\n", "")
            faults[i] = faults[i] or text.format(value)
    return faults
