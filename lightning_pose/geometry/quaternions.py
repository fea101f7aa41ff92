"""Quaternions, relative poses and pose errors: pure, batched, differentiable torch functions.

Quaternions are Hamilton, `wxyz`, camera-to-world; q and -q are the same rotation. Positions are in metres (or the
scene's unit). Leading dimensions are batch dimensions: those written `*#batch` broadcast.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
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


def quat_normalize(quat_wxyz: Float[Tensor, "*batch 4"]) -> Float[Tensor, "*batch 4"]:
    """Scale quaternions of any length to unit length.

    A zero quaternion becomes the identity, with zero gradient; NaN stays NaN.

    >>> quat_normalize(torch.tensor([0.0, 3.0, 0.0, 4.0]))
    tensor([0.0000, 0.6000, 0.0000, 0.8000])
    """
    identity = quat_wxyz.new_tensor([1.0, 0.0, 0.0, 0.0])
    is_zero = torch.linalg.vector_norm(quat_wxyz, dim=-1, keepdim=True) == 0
    quat_wxyz = torch.where(is_zero, identity, quat_wxyz)
    return quat_wxyz / torch.linalg.vector_norm(quat_wxyz, dim=-1, keepdim=True)


def quat_multiply(a: Float[Tensor, "*#batch 4"], b: Float[Tensor, "*#batch 4"]) -> Float[Tensor, "*batch 4"]:
    """Hamilton product of two quaternions: the rotation b followed by the rotation a, as in `R_a @ R_b`.

    The product of unit quaternions has unit length.

    >>> i, j = torch.tensor([0.0, 1, 0, 0]), torch.tensor([0.0, 0, 1, 0])
    >>> quat_multiply(i, j)  # k
    tensor([0., 0., 0., 1.])
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


def quat_conjugate(quat_wxyz: Float[Tensor, "*batch 4"]) -> Float[Tensor, "*batch 4"]:
    """Negate the vector part, which gives the inverse rotation of a unit quaternion.

    >>> quat_conjugate(torch.tensor([0.5, 0.5, -0.5, 0.5]))
    tensor([ 0.5000, -0.5000,  0.5000, -0.5000])
    """
    return quat_wxyz * quat_wxyz.new_tensor([1.0, -1.0, -1.0, -1.0])


def quat_rotate(quat_wxyz: Float[Tensor, "*#batch 4"], vector: Float[Tensor, "*#batch 3"]) -> Float[Tensor, "*batch 3"]:
    """Rotate vectors by unit quaternions: `R(quat) @ vector`.

    >>> half_turn_about_z = torch.tensor([0.0, 0, 0, 1])
    >>> quat_rotate(half_turn_about_z, torch.tensor([1.0, 2, 3]))
    tensor([-1., -2.,  3.])
    """
    w, u = quat_wxyz[..., :1], quat_wxyz[..., 1:]
    u, vector = torch.broadcast_tensors(u, vector)
    t = 2 * torch.linalg.cross(u, vector)
    return vector + w * t + torch.linalg.cross(u, t)


def quat_to_matrix(quat_wxyz: Float[Tensor, "*batch 4"]) -> Float[Tensor, "*batch 3 3"]:
    """Rotation matrices of unit quaternions.

    >>> quat_to_matrix(torch.tensor([0.5, 0.5, 0.5, 0.5]))  # a third of a turn: x to y to z to x
    tensor([[0., 0., 1.],
            [1., 0., 0.],
            [0., 1., 0.]])
    """
    w, x, y, z = quat_wxyz.unbind(-1)
    rows = [
        torch.stack([1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)], dim=-1),
        torch.stack([2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)], dim=-1),
        torch.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], dim=-1),
    ]
    return torch.stack(rows, dim=-2)


def matrix_to_quat(matrix: Float[Tensor, "*batch 3 3"]) -> Float[Tensor, "*batch 4"]:
    """Unit quaternions, with w >= 0, of rotation matrices; accurate at every angle, half turns included.

    That the matrices are rotations is not checked.

    >>> matrix_to_quat(torch.diag(torch.tensor([1.0, -1, -1])))  # half a turn about x
    tensor([0., 1., 0., 0.])
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


def align_hemisphere(
    quat_wxyz: Float[Tensor, "*#batch 4"], reference: Float[Tensor, "*#batch 4"]
) -> Float[Tensor, "*batch 4"]:
    """Of q and -q, which are one rotation, the quaternion with `<q, reference> >= 0`.

    A product of exactly zero leaves q as it is.

    >>> align_hemisphere(torch.tensor([-1.0, 0, 0, 0]), torch.tensor([1.0, 0, 0, 0]))
    tensor([1., -0., -0., -0.])
    """
    opposite = (quat_wxyz * reference).sum(-1, keepdim=True) < 0
    return torch.where(opposite, -quat_wxyz, quat_wxyz)


def mean_quat(
    quat_wxyz: Float[Tensor, "*batch n 4"], weights: Float[Tensor, "*batch n"] | None = None
) -> Float[Tensor, "*batch 4"]:
    """Mean rotation: the principal eigenvector of sum(w q q^T) (Markley et al., JGCD 2007).

    The signs of the quaternions make no difference to the rotation.

    Args:
        quat_wxyz: unit; n at least 1.
        weights: non-negative, not all zero; equal weights when None.

    Returns:
        unit quaternions, in the hemisphere of the first of the n. Where the mean is not unique (two rotations half
        a turn apart), one of the candidates.

    >>> rotations = torch.tensor([[1.0, 0, 0, 0], [0.6, 0.8, 0, 0], [0.6, -0.8, 0, 0]])
    >>> mean_quat(rotations).round(decimals=3).abs()
    tensor([1., 0., 0., 0.])
    """
    weighted = quat_wxyz if weights is None else quat_wxyz * weights.unsqueeze(-1)
    principal = torch.linalg.eigh(weighted.mT @ quat_wxyz).eigenvectors[..., -1]
    return align_hemisphere(principal, quat_wxyz[..., 0, :])


def orientation_error_deg(a: Float[Tensor, "*#batch 4"], b: Float[Tensor, "*#batch 4"]) -> Float[Tensor, "*batch"]:
    """Angle of the rotation between two orientations, `2 * acos(|<a, b>|)`, in degrees, 0 to 180.

    Computed as `4 * atan2(|a - b|, |a + b|)`, which is accurate near zero, where acos in float32 gives 0 for 0.03
    degrees. Quaternions of any length are accepted; NaN gives NaN.

    >>> orientation_error_deg(torch.tensor([1.0, 0, 0, 0]), torch.tensor([-1.0, 0, 0, 1]))  # a quarter turn
    tensor(90.)
    """
    a, b = quat_normalize(a), quat_normalize(b)
    difference = torch.linalg.vector_norm(a - b, dim=-1)
    total = torch.linalg.vector_norm(a + b, dim=-1)
    half_angle = 2 * torch.atan2(torch.minimum(difference, total), torch.maximum(difference, total))
    return torch.rad2deg(2 * half_angle)


def position_error_m(a: Float[Tensor, "*#batch 3"], b: Float[Tensor, "*#batch 3"]) -> Float[Tensor, "*batch"]:
    """Euclidean distance between positions, in their unit.

    >>> position_error_m(torch.tensor([3.0, 0, 1]), torch.tensor([0.0, 4, 1]))
    tensor(5.)
    """
    return torch.linalg.vector_norm(a - b, dim=-1)


def relative_pose(
    position_a: Float[Tensor, "*#batch 3"],
    quat_a: Float[Tensor, "*#batch 4"],
    position_b: Float[Tensor, "*#batch 3"],
    quat_b: Float[Tensor, "*#batch 4"],
) -> tuple[Float[Tensor, "*batch 3"], Float[Tensor, "*batch 4"]]:
    """Pose of b relative to a, `T_a^-1 T_b`, its position in the axes of a; the inverse of `compose_pose`.

    All quaternions are unit.

    >>> half_turn_about_z = torch.tensor([0.0, 0, 0, 1])
    >>> a, b = torch.tensor([1.0, 0, 0]), torch.tensor([3.0, 0, 5])
    >>> relative_pose(a, half_turn_about_z, b, half_turn_about_z)
    (tensor([-2.,  0.,  5.]), tensor([1., 0., 0., 0.]))
    """
    inverse = quat_conjugate(quat_a)
    return quat_rotate(inverse, position_b - position_a), quat_multiply(inverse, quat_b)


def compose_pose(
    position_a: Float[Tensor, "*#batch 3"],
    quat_a: Float[Tensor, "*#batch 4"],
    position_ab: Float[Tensor, "*#batch 3"],
    quat_ab: Float[Tensor, "*#batch 4"],
) -> tuple[Float[Tensor, "*batch 3"], Float[Tensor, "*batch 4"]]:
    """Pose of b in the world, `T_a T_ab`, from the pose of a in the world and the pose of b relative to a.

    All quaternions are unit.

    >>> half_turn_about_z, identity = torch.tensor([0.0, 0, 0, 1]), torch.tensor([1.0, 0, 0, 0])
    >>> compose_pose(torch.tensor([1.0, 0, 0]), half_turn_about_z, torch.tensor([-2.0, 0, 5]), identity)
    (tensor([3., 0., 5.]), tensor([0., 0., 0., 1.]))
    """
    return position_a + quat_rotate(quat_a, position_ab), quat_multiply(quat_a, quat_ab)
