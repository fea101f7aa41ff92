"""Baselines of clips: known answers."""

from __future__ import annotations

import math

import pytest
import torch

from lightning_pose.errors import ConfigError
from lightning_pose.evaluation.baselines.clips import predict_constant_velocity, predict_no_motion
from lightning_pose.geometry.quaternions import compose_pose, orientation_error_deg, quat_normalize
from lightning_pose.geometry.relative import RelativeFrame, relative_poses

FRAMES: list[RelativeFrame] = ["camera", "world"]
IDENTITY = torch.eye(4)[0].double()


def yaw(degrees: float) -> torch.Tensor:
    """(4,) a turn about y."""
    half = math.radians(degrees) / 2
    return torch.tensor([math.cos(half), 0, math.sin(half), 0], dtype=torch.float64)


def walk(step_m: torch.Tensor, turn: torch.Tensor, length: int) -> tuple[torch.Tensor, torch.Tensor]:
    """(1, length, 3) and (1, length, 4) in the world: the same step of the camera again and again."""
    poses = [(torch.tensor([5.0, 6, 7]).double(), quat_normalize(torch.tensor([0.3, -0.5, 0.8, 0.1]).double()))]
    for _ in range(length - 1):
        poses.append(compose_pose(*poses[-1], step_m, turn))
    positions, quats = zip(*poses, strict=True)
    return torch.stack(positions)[None], torch.stack(quats)[None]


def test_no_motion_is_the_first_pose() -> None:
    position_m, quat_wxyz = predict_no_motion(2, 3)
    assert torch.equal(position_m, torch.zeros(2, 3, 3).double())
    assert torch.equal(quat_wxyz, IDENTITY.expand(2, 3, 4))


def test_in_camera_axes_a_constant_velocity_is_followed_around_the_bend() -> None:
    poses = walk(torch.tensor([0.1, 0, 0.5]).double(), yaw(20), 12)
    short = relative_poses(poses[0][:, :4], poses[1][:, :4])
    position_m, quat_wxyz = predict_constant_velocity(*short, length=12)
    expected = relative_poses(*poses)
    torch.testing.assert_close(position_m, expected[0][0])
    assert orientation_error_deg(quat_wxyz, expected[1][0]).max() < 1e-5


def test_in_world_axes_a_constant_velocity_is_a_line() -> None:
    position = torch.arange(4)[None, :, None] * torch.tensor([1.0, 2, -3]).double()
    turned = walk(torch.zeros(3).double(), yaw(20), 12)[1]
    position_m, quat_wxyz = predict_constant_velocity(position, turned[:, :4], 12, "world")
    torch.testing.assert_close(position_m, torch.arange(12)[:, None] * torch.tensor([1.0, 2, -3]).double())
    assert orientation_error_deg(quat_wxyz, relative_poses(position_m[None], turned)[1][0]).max() < 1e-5


@pytest.mark.parametrize("relative_frame", FRAMES)
def test_the_mean_step_is_of_all_steps_of_all_clips(relative_frame: RelativeFrame) -> None:
    """Along z by 1, 2, 3 and 4 metres, turned about z (which leaves z alone) by 0, 10, 20 and 30 degrees."""
    half = torch.deg2rad(torch.tensor([[0.0, 0, 10], [0, 20, 50]]).double()) / 2
    zeros = torch.zeros_like(half)
    signs = torch.tensor([[1.0, -1, 1], [1, 1, -1]])[..., None]  # q and -q are one rotation
    quat = torch.stack([half.cos(), zeros, zeros, half.sin()], dim=-1) * signs
    position = torch.stack([zeros, zeros, torch.tensor([[0.0, 1, 3], [0, 3, 7]])], dim=-1)
    position_m, quat_wxyz = predict_constant_velocity(position.numpy(), quat.numpy(), 3, relative_frame)
    torch.testing.assert_close(position_m, torch.tensor([[0, 0, 0], [0, 0, 2.5], [0, 0, 5]]).double())
    angles = orientation_error_deg(quat_wxyz, IDENTITY)
    assert angles.tolist() == pytest.approx([0, 15, 30], abs=1e-6)


@pytest.mark.parametrize("relative_frame", FRAMES)
def test_world_poses_and_relative_ones_have_the_same_steps(relative_frame: RelativeFrame) -> None:
    generator = torch.Generator().manual_seed(0)
    position = torch.randn(4, 5, 3, generator=generator).double()
    quat = quat_normalize(torch.tensor([1.0, 0, 0, 0]) + 0.3 * torch.randn(4, 5, 4, generator=generator).double())
    from_world = predict_constant_velocity(position, quat, 7, relative_frame)
    from_relative = predict_constant_velocity(*relative_poses(position, quat, relative_frame), 7, relative_frame)
    torch.testing.assert_close(from_world[0], from_relative[0])
    assert orientation_error_deg(from_world[1], from_relative[1]).max() < 1e-5


def test_clips_without_a_step_are_refused() -> None:
    train = walk(torch.ones(3).double(), yaw(10), 4)
    for length in (0, 1):
        with pytest.raises(ConfigError, match=rf"shape \(1, {length}, 3\) have no step; give \(M, T, 3\)"):
            predict_constant_velocity(train[0][:, :length], train[1][:, :length], 5)
    with pytest.raises(ConfigError, match="relative_frame is 'body'"):
        predict_constant_velocity(*train, 5, "body")  # type: ignore[arg-type]
