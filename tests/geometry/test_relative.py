"""Tests of relative poses: round trips, what each frame of reference means, chains of overlapping clips."""

from __future__ import annotations

import math

import pytest
import torch

from lightning_pose.errors import ConfigError
from lightning_pose.geometry.quaternions import orientation_error_deg, quat_normalize, relative_pose
from lightning_pose.geometry.relative import (
    Chain,
    RelativeFrame,
    absolute_poses,
    chain_steps,
    check_relative_frame,
    relative_poses,
)

FRAMES: list[RelativeFrame] = ["camera", "world"]


def walk(*shape: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Random poses, (..., 3) and (..., 4), float64."""
    generator = torch.Generator().manual_seed(0)
    position_m = torch.randn(*shape, 3, generator=generator, dtype=torch.float64) * 3
    quat_wxyz = quat_normalize(torch.randn(*shape, 4, generator=generator, dtype=torch.float64))
    return position_m, quat_wxyz


@pytest.mark.parametrize("frame", FRAMES)
@pytest.mark.parametrize("shape", [(7,), (5, 7), (2, 3, 4)])
def test_absolute_to_relative_and_back(frame: RelativeFrame, shape: tuple[int, ...]) -> None:
    position_m, quat_wxyz = walk(*shape)
    relative = relative_poses(position_m, quat_wxyz, frame)
    first = position_m[..., 0, :], quat_wxyz[..., 0, :]
    back_position, back_quat = absolute_poses(*relative, *first, frame)
    torch.testing.assert_close(back_position, position_m)
    assert orientation_error_deg(back_quat, quat_wxyz).max() < 1e-6


@pytest.mark.parametrize("frame", FRAMES)
def test_the_first_frame_is_the_origin(frame: RelativeFrame) -> None:
    position_m, quat_wxyz = relative_poses(*walk(4, 3), frame)
    assert not position_m[:, 0].any()
    torch.testing.assert_close(quat_wxyz[:, 0], torch.tensor([1.0, 0, 0, 0]).double().expand(4, 4))
    assert (quat_wxyz[..., 0] >= 0).all()


def test_camera_axes_are_those_of_the_transformation_between_cameras() -> None:
    position_m, quat_wxyz = walk(2)
    expected = relative_pose(position_m[0], quat_wxyz[0], position_m[1], quat_wxyz[1])
    relative = relative_poses(position_m, quat_wxyz, "camera")
    torch.testing.assert_close(relative[0][1], expected[0])
    assert orientation_error_deg(relative[1][1], expected[1]) < 1e-6


def test_camera_axes_do_not_depend_on_the_world_and_world_axes_do() -> None:
    position_m, quat_wxyz = walk(5)
    turn = quat_normalize(torch.tensor([0.3, -0.5, 0.8, 0.1], dtype=torch.float64))
    elsewhere = absolute_poses(position_m, quat_wxyz, torch.tensor([7.0, 8, 9]).double(), turn)
    torch.testing.assert_close(relative_poses(*elsewhere, "camera"), relative_poses(position_m, quat_wxyz, "camera"))
    there, here = (relative_poses(*poses, "world")[0] for poses in (elsewhere, (position_m, quat_wxyz)))
    assert (there - here).norm() > 1


def test_world_axes_are_equation_6_1() -> None:
    position_m, quat_wxyz = walk(5)
    torch.testing.assert_close(relative_poses(position_m, quat_wxyz, "world")[0], position_m - position_m[:1])


@pytest.mark.parametrize("frame", FRAMES)
@pytest.mark.parametrize(("length", "hop"), [(4, 3), (5, 2), (2, 1), (12, 5)])
def test_a_chain_of_true_clips_is_the_trajectory(frame: RelativeFrame, length: int, hop: int) -> None:
    position_m, quat_wxyz = walk(12)
    chain = Chain(frame, position_m[0], quat_wxyz[0])
    added: list[int] = []
    for start in range(0, 12 - 1, hop):
        rows = list(range(start, min(start + length, 12)))
        added += chain.add(rows, *relative_poses(position_m[rows], quat_wxyz[rows], frame))
    numbers, chained_position, chained_quat = chain.trajectory()
    assert added == numbers == list(range(12))
    torch.testing.assert_close(chained_position, position_m)
    assert orientation_error_deg(chained_quat, quat_wxyz).max() < 1e-5


def test_a_chain_begins_at_the_origin_and_keeps_poses_it_has_returned() -> None:
    position_m, quat_wxyz = relative_poses(*walk(3))
    chain = Chain()
    assert chain.add([10, 11, 12], position_m, quat_wxyz) == [10, 11, 12]
    before = chain.poses[12][0].clone()
    assert chain.add([11, 12, 13], position_m * 2, quat_wxyz) == [13]
    torch.testing.assert_close(chain.poses[12][0], before)
    torch.testing.assert_close(chain.poses[10][0], torch.zeros(3).double())


def test_clips_that_do_not_overlap_are_refused() -> None:
    chain = Chain()
    chain.add([0, 1], *relative_poses(*walk(2)))
    with pytest.raises(ConfigError, match="begins at frame 2, but only 0 to 1 are known; let clips overlap"):
        chain.add([2, 3], *relative_poses(*walk(2)))
    with pytest.raises(ConfigError, match="relative_frame is 'body'; give one of camera, world"):
        check_relative_frame("body")


def test_chained_steps_turn_with_the_camera() -> None:
    """Four quarter turns to the right, one metre ahead before each: a square."""
    half = math.sqrt(0.5)
    position_m, quat_wxyz = chain_steps(
        torch.tensor([0.0, 0, 1]).expand(1, 4, 3).double(), torch.tensor([half, 0, half, 0]).expand(1, 4, 4).double()
    )
    expected = torch.tensor([[0.0, 0, 0], [0, 0, 1], [1, 0, 1], [1, 0, 0], [0, 0, 0]]).double()
    torch.testing.assert_close(position_m[0], expected)
    torch.testing.assert_close(quat_wxyz[0, 4], torch.eye(4)[0].double())
    assert (quat_wxyz[..., 0] >= 0).all()
