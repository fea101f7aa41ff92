"""Quaternions, relative poses and pose errors: pure, batched, differentiable torch functions.

Quaternions are Hamilton, `wxyz`, camera-to-world; q and -q are the same rotation. Leading dimensions are
batch and broadcast. Positions are in metres (or the scene's unit).
"""

from __future__ import annotations

import torch
from torch import Tensor

__all__ = [
    "align_hemisphere",
    "compose_pose",
    "matrix_to_quat",
    "mean_quat",
    "orientation_error_deg",
    "position_error_m",
    "quat_conjugate",
    "quat_multiply",
    "quat_normalize",
    "quat_rotate",
    "quat_to_matrix",
    "relative_pose",
]


def quat_normalize(quat_wxyz: Tensor) -> Tensor:
    """Scale quaternions to unit length.

    Args:
        quat_wxyz: (..., 4), any length.

    Returns:
        (..., 4), unit. A zero quaternion becomes the identity, with zero gradient; NaN stays NaN.
    """
    identity = quat_wxyz.new_tensor([1.0, 0.0, 0.0, 0.0])
    is_zero = torch.linalg.vector_norm(quat_wxyz, dim=-1, keepdim=True) == 0
    quat_wxyz = torch.where(is_zero, identity, quat_wxyz)
    return quat_wxyz / torch.linalg.vector_norm(quat_wxyz, dim=-1, keepdim=True)


def quat_multiply(a: Tensor, b: Tensor) -> Tensor:
    """Hamilton product: the rotation b followed by the rotation a, as in `R_a @ R_b`.

    Args:
        a: (..., 4) wxyz.
        b: (..., 4) wxyz.

    Returns:
        (..., 4) wxyz; unit where both are.
    """
    aw, ax, ay, az = a.unbind(-1)
    bw, bx, by, bz = b.unbind(-1)
    return torch.stack(
        [
            aw * bw - ax * bx - ay * by - az * bz,
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
        ],
        dim=-1,
    )


def quat_conjugate(quat_wxyz: Tensor) -> Tensor:
    """(..., 4) with the vector part negated: the inverse rotation of a unit quaternion."""
    return quat_wxyz * quat_wxyz.new_tensor([1.0, -1.0, -1.0, -1.0])


def quat_rotate(quat_wxyz: Tensor, vector: Tensor) -> Tensor:
    """Rotate vectors: `R(quat) @ vector`.

    Args:
        quat_wxyz: (..., 4), unit.
        vector: (..., 3).

    Returns:
        (..., 3).
    """
    w, u = quat_wxyz[..., :1], quat_wxyz[..., 1:]
    u, vector = torch.broadcast_tensors(u, vector)
    t = 2 * torch.linalg.cross(u, vector)
    return vector + w * t + torch.linalg.cross(u, t)


def quat_to_matrix(quat_wxyz: Tensor) -> Tensor:
    """Rotation matrices, (..., 3, 3), of unit quaternions, (..., 4)."""
    w, x, y, z = quat_wxyz.unbind(-1)
    rows = [
        torch.stack([1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)], dim=-1),
        torch.stack([2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)], dim=-1),
        torch.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], dim=-1),
    ]
    return torch.stack(rows, dim=-2)


def matrix_to_quat(matrix: Tensor) -> Tensor:
    """Unit quaternions of rotation matrices, accurate at every angle, half turns included.

    Args:
        matrix: (..., 3, 3), proper rotations (not checked).

    Returns:
        (..., 4) wxyz, unit, with w >= 0.
    """
    (m00, m01, m02), (m10, m11, m12), (m20, m21, m22) = (row.unbind(-1) for row in matrix.unbind(-2))
    # Row i is 4 * q_i * q: every row points along q, and the one with the largest q_i has no cancellation.
    rows = [
        torch.stack([1 + m00 + m11 + m22, m21 - m12, m02 - m20, m10 - m01], dim=-1),
        torch.stack([m21 - m12, 1 + m00 - m11 - m22, m01 + m10, m02 + m20], dim=-1),
        torch.stack([m02 - m20, m01 + m10, 1 - m00 + m11 - m22, m12 + m21], dim=-1),
        torch.stack([m10 - m01, m02 + m20, m12 + m21, 1 - m00 - m11 + m22], dim=-1),
    ]
    products = torch.stack(rows, dim=-2)
    largest = products.diagonal(dim1=-2, dim2=-1).argmax(-1)
    row = products.take_along_dim(largest[..., None, None], dim=-2).squeeze(-2)
    return align_hemisphere(quat_normalize(row), row.new_tensor([1.0, 0.0, 0.0, 0.0]))


def align_hemisphere(quat_wxyz: Tensor, reference: Tensor) -> Tensor:
    """Choose, of q and -q, the one on the reference's side.

    Args:
        quat_wxyz: (..., 4).
        reference: (..., 4).

    Returns:
        (..., 4), the same rotations, with <q, reference> >= 0; a product of exactly zero leaves q as it is.
    """
    opposite = (quat_wxyz * reference).sum(-1, keepdim=True) < 0
    return torch.where(opposite, -quat_wxyz, quat_wxyz)


def mean_quat(quat_wxyz: Tensor, weights: Tensor | None = None) -> Tensor:
    """Mean rotation: the principal eigenvector of sum(w q q^T), blind to signs (Markley et al., JGCD 2007).

    Args:
        quat_wxyz: (..., N, 4), unit, N >= 1.
        weights: (..., N), non-negative, not all zero; equal weights when None.

    Returns:
        (..., 4), unit, on the side of the first quaternion. Where the mean is not unique (two rotations
        half a turn apart), one of the candidates.
    """
    weighted = quat_wxyz if weights is None else quat_wxyz * weights.unsqueeze(-1)
    principal = torch.linalg.eigh(weighted.mT @ quat_wxyz).eigenvectors[..., -1]
    return align_hemisphere(principal, quat_wxyz[..., 0, :])


def orientation_error_deg(a: Tensor, b: Tensor) -> Tensor:
    """Angle of the rotation between two orientations, `2 * acos(|<a, b>|)`, in degrees.

    Computed as `4 * atan2(|a - b|, |a + b|)`: acos loses all digits near zero (in float32 0.03 degrees
    become 0), this keeps them.

    Args:
        a: (..., 4) wxyz; any length, normalised here.
        b: (..., 4) wxyz; any length, normalised here.

    Returns:
        (...), 0 to 180; NaN where an input is.
    """
    a, b = quat_normalize(a), quat_normalize(b)
    difference = torch.linalg.vector_norm(a - b, dim=-1)
    total = torch.linalg.vector_norm(a + b, dim=-1)
    half_angle = 2 * torch.atan2(torch.minimum(difference, total), torch.maximum(difference, total))
    return torch.rad2deg(2 * half_angle)


def position_error_m(a: Tensor, b: Tensor) -> Tensor:
    """Euclidean distance, (...), between positions, (..., 3) and (..., 3), in their unit."""
    return torch.linalg.vector_norm(a - b, dim=-1)


def relative_pose(position_a: Tensor, quat_a: Tensor, position_b: Tensor, quat_b: Tensor) -> tuple[Tensor, Tensor]:
    """Pose of b seen from a: `T_a^-1 T_b`, the translation in the axes of a.

    Args:
        position_a: (..., 3).
        quat_a: (..., 4) wxyz, unit.
        position_b: (..., 3).
        quat_b: (..., 4) wxyz, unit.

    Returns:
        position (..., 3) and quat_wxyz (..., 4) of b in a; the inverse of `compose_pose`.
    """
    inverse = quat_conjugate(quat_a)
    return quat_rotate(inverse, position_b - position_a), quat_multiply(inverse, quat_b)


def compose_pose(position_a: Tensor, quat_a: Tensor, position_ab: Tensor, quat_ab: Tensor) -> tuple[Tensor, Tensor]:
    """Pose of b in the world, `T_a T_ab`, from the pose of a and the pose of b seen from a.

    Args:
        position_a: (..., 3).
        quat_a: (..., 4) wxyz, unit.
        position_ab: (..., 3).
        quat_ab: (..., 4) wxyz, unit.

    Returns:
        position (..., 3) and quat_wxyz (..., 4).
    """
    return position_a + quat_rotate(quat_a, position_ab), quat_multiply(quat_a, quat_ab)
