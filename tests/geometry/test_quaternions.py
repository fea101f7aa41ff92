"""Geometry: known rotations, agreement with SciPy, degenerate cases, and gradients."""

from __future__ import annotations

import math

import pytest
import torch
from scipy.spatial.transform import Rotation

from lightning_pose.geometry.quaternions import (
    align_hemisphere,
    compose_pose,
    matrix_to_quat,
    mean_quat,
    orientation_error_deg,
    position_error_m,
    quat_conjugate,
    quat_multiply,
    quat_normalize,
    quat_rotate,
    quat_to_matrix,
    relative_pose,
)

IDENTITY = torch.tensor([1.0, 0.0, 0.0, 0.0], dtype=torch.float64)


def random_quats(*shape: int, seed: int = 0) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    return quat_normalize(torch.randn(*shape, 4, generator=generator, dtype=torch.float64))


def about_z(degrees: float, dtype: torch.dtype = torch.float64) -> torch.Tensor:
    half = math.radians(degrees) / 2
    return torch.tensor([math.cos(half), 0.0, 0.0, math.sin(half)], dtype=dtype)


def to_scipy(quat: torch.Tensor) -> Rotation:
    return Rotation.from_quat(quat.numpy()[..., [1, 2, 3, 0]])


def test_normalize_zero_is_identity_and_nan_stays() -> None:
    quat = torch.tensor([[0.0, 0.0, 0.0, 0.0], [0.0, 3.0, 0.0, 4.0], [float("nan"), 0.0, 0.0, 1.0]])
    result = quat_normalize(quat)
    torch.testing.assert_close(result[:2], torch.tensor([[1.0, 0.0, 0.0, 0.0], [0.0, 0.6, 0.0, 0.8]]))
    assert result[2].isnan().all()


def test_normalize_has_finite_gradient_at_zero() -> None:
    quat = torch.zeros(2, 4, requires_grad=True)
    quat_normalize(quat).sum().backward()
    assert quat.grad is not None
    assert quat.grad.isfinite().all()


def test_quarter_turn_about_z_takes_x_to_y() -> None:
    x_axis = torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64)
    y_axis = torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64)
    torch.testing.assert_close(quat_rotate(about_z(90), x_axis), y_axis)
    torch.testing.assert_close(quat_to_matrix(about_z(90)) @ x_axis, y_axis)


def test_product_rotation_and_matrix_agree_with_scipy() -> None:
    a, b = random_quats(20), random_quats(20, seed=1)
    vector = torch.randn(20, 3, dtype=torch.float64)
    product = torch.from_numpy((to_scipy(a) * to_scipy(b)).as_matrix())
    torch.testing.assert_close(quat_to_matrix(quat_multiply(a, b)), product)
    torch.testing.assert_close(quat_rotate(a, vector), torch.from_numpy(to_scipy(a).apply(vector.numpy())))


def test_conjugate_is_the_inverse_rotation() -> None:
    quat = random_quats(5)
    torch.testing.assert_close(quat_multiply(quat, quat_conjugate(quat)), IDENTITY.expand(5, 4))


def test_functions_broadcast_over_leading_dimensions() -> None:
    quat, vector = random_quats(4, 1), torch.randn(7, 3, dtype=torch.float64)
    assert quat_rotate(quat, vector).shape == (4, 7, 3)
    assert quat_multiply(quat, random_quats(7)).shape == (4, 7, 4)
    assert matrix_to_quat(quat_to_matrix(quat)).shape == (4, 1, 4)


def test_matrix_round_trip_random() -> None:
    quat = align_hemisphere(random_quats(500), IDENTITY)
    torch.testing.assert_close(matrix_to_quat(quat_to_matrix(quat)), quat)


@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_matrix_to_quat_at_half_turns(axis: int, dtype: torch.dtype) -> None:
    quat = torch.zeros(4, dtype=dtype)
    quat[1 + axis] = 1
    result = matrix_to_quat(quat_to_matrix(quat))
    torch.testing.assert_close(align_hemisphere(result, quat), quat)


def test_matrix_to_quat_gradient() -> None:
    matrix = quat_to_matrix(random_quats(3)).requires_grad_()
    assert torch.autograd.gradcheck(matrix_to_quat, (matrix,))


def test_align_hemisphere_flips_only_the_far_side() -> None:
    quat = torch.stack([about_z(10), -about_z(10)])
    torch.testing.assert_close(align_hemisphere(quat, IDENTITY), about_z(10).expand(2, 4))


def test_mean_quat_is_halfway_whatever_the_signs() -> None:
    pair = torch.stack([about_z(0), about_z(40)])
    torch.testing.assert_close(mean_quat(pair), about_z(20))
    flipped = mean_quat(pair * torch.tensor([[1.0], [-1.0]], dtype=torch.float64))
    torch.testing.assert_close(flipped, about_z(20))


def test_mean_quat_weights_and_batch() -> None:
    pair = torch.stack([about_z(0), about_z(40)]).expand(3, 2, 4)
    weights = torch.tensor([[1.0, 0.0], [0.0, 2.0], [1.0, 1.0]], dtype=torch.float64)
    expected = torch.stack([about_z(0), about_z(40), about_z(20)])
    torch.testing.assert_close(mean_quat(pair, weights), expected)


def test_mean_quat_agrees_with_scipy() -> None:
    quat = random_quats(30)
    expected = torch.from_numpy(to_scipy(quat).mean().as_quat())[[3, 0, 1, 2]]
    torch.testing.assert_close(align_hemisphere(mean_quat(quat), expected), expected)


@pytest.mark.parametrize("degrees", [0.0, 1e-3, 0.03, 1.0, 90.0, 179.99, 180.0])
def test_orientation_error_is_accurate_in_float32(degrees: float) -> None:
    error = orientation_error_deg(about_z(0, torch.float32), -about_z(degrees, torch.float32))
    assert error.item() == pytest.approx(degrees, rel=1e-4, abs=1e-5)


def test_orientation_error_normalises_and_keeps_nan() -> None:
    assert orientation_error_deg(3 * about_z(10), about_z(30)).item() == pytest.approx(20)
    assert orientation_error_deg(about_z(10) * float("nan"), IDENTITY).isnan()


def test_orientation_error_gradient_is_finite_at_zero() -> None:
    quat = about_z(30).requires_grad_()
    orientation_error_deg(quat, about_z(30)).backward()
    assert quat.grad is not None
    assert quat.grad.isfinite().all()


def test_position_error_is_euclidean() -> None:
    assert position_error_m(torch.tensor([3.0, 0.0, 0.0]), torch.tensor([0.0, 4.0, 0.0])).item() == 5


def test_relative_pose_known_value() -> None:
    position, quat = relative_pose(
        torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64),
        about_z(90),
        torch.tensor([1.0, 2.0, 0.0], dtype=torch.float64),
        about_z(120),
    )
    torch.testing.assert_close(position, torch.tensor([2.0, 0.0, 0.0], dtype=torch.float64))
    torch.testing.assert_close(quat, about_z(30))


def test_relative_then_compose_returns_the_pose() -> None:
    p_a, p_b = torch.randn(2, 6, 3, dtype=torch.float64)
    q_a, q_b = random_quats(6), random_quats(6, seed=1)
    position, quat = compose_pose(p_a, q_a, *relative_pose(p_a, q_a, p_b, q_b))
    torch.testing.assert_close(position, p_b)
    torch.testing.assert_close(quat, q_b)
