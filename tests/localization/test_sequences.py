"""Whole sequences from a model of clips: windows that chain, and trajectories of any length."""

from __future__ import annotations

from typing import Any, cast

import pytest
import torch
from torch import Tensor

from lightning_pose.geometry.quaternions import orientation_error_deg, quat_normalize
from lightning_pose.geometry.relative import Chain, RelativeFrame, relative_poses
from lightning_pose.localization.sequences import cut_windows, locate_sequence
from lightning_pose.models.base import Pose


class Knowing:
    """A model that reads true poses as features, and answers with those relative to the first."""

    device = torch.device("cpu")

    def __init__(self, frame: RelativeFrame) -> None:
        self.frame: RelativeFrame = frame
        self.lengths: list[int] = []

    def __call__(self, features: Tensor) -> Pose:
        self.lengths.append(features.shape[1])
        return Pose(*relative_poses(features[..., :3], features[..., 3:], self.frame))


def walk(count: int) -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(0)
    quat_wxyz = quat_normalize(torch.randn(count, 4, generator=generator).double())
    return torch.randn(count, 3, generator=generator).double(), quat_wxyz


@pytest.mark.parametrize(
    ("frames", "length", "expected"),
    [(7, 4, [(0, 4), (3, 7)]), (8, 4, [(0, 4), (3, 7), (6, 8)]), (3, 10, [(0, 3)]), (3, 2, [(0, 2), (1, 3)]),
     (1, 4, [(0, 1)])],
)  # fmt: skip
def test_windows_share_a_frame(frames: int, length: int, expected: list[tuple[int, int]]) -> None:
    assert [(window.start, window.stop) for window in cut_windows(frames, length)] == expected


@pytest.mark.parametrize("frame", ["camera", "world"])
@pytest.mark.parametrize(("count", "length"), [(23, 5), (4, 10), (1, 3), (12, 2)])
def test_a_model_that_knows_gives_the_true_trajectory(frame: RelativeFrame, count: int, length: int) -> None:
    position_m, quat_wxyz = walk(count)
    model: Any = Knowing(frame)
    found = locate_sequence(model, torch.cat([position_m, quat_wxyz], 1), length, frame, position_m[0], quat_wxyz[0])
    torch.testing.assert_close(found[0], position_m)
    assert orientation_error_deg(found[1], quat_wxyz).max() < 1e-5
    assert max(model.lengths) <= length


def test_without_a_start_it_begins_at_the_origin() -> None:
    position_m, quat_wxyz = walk(6)
    model = cast("Any", Knowing("camera"))
    found = locate_sequence(model, torch.cat([position_m, quat_wxyz], 1), 4)
    expected = relative_poses(position_m, quat_wxyz)
    torch.testing.assert_close(found[0], expected[0])
    torch.testing.assert_close(found[1][0], torch.eye(4)[0].double())


def test_a_live_camera_is_followed_frame_by_frame() -> None:
    """A clip of the last four frames each time: every frame is placed as soon as it comes."""
    position_m, quat_wxyz = walk(9)
    model, chain = cast("Any", Knowing("camera")), Chain("camera", position_m[0], quat_wxyz[0])
    for now in range(1, 9):
        numbers = list(range(max(0, now - 3), now + 1))
        pose = model(torch.cat([position_m, quat_wxyz], 1)[numbers][None])
        assert chain.add(numbers, pose.position_m[0], pose.quat_wxyz[0])[-1] == now
    torch.testing.assert_close(chain.trajectory()[1], position_m)
