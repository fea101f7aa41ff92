"""Mirrored poses by hand: turns about each axis, and where a camera's image shows a point."""

from __future__ import annotations

import math

import pytest
import torch

from lightning_pose.data.clip_dataset import mirror_poses

C, S = math.cos(0.2), math.sin(0.2)


@pytest.mark.parametrize(
    ("quat_wxyz", "expected"),
    [
        ([C, S, 0, 0], [C, S, 0, 0]),  # up and down stay as they are
        ([C, 0, S, 0], [C, 0, -S, 0]),  # a turn to the right becomes one to the left
        ([C, 0, 0, S], [C, 0, 0, -S]),  # so does a roll
    ],
)
def test_turns_about_each_axis(quat_wxyz: list[float], expected: list[float]) -> None:
    position_m, turned = mirror_poses(torch.tensor([[1.0, 2.0, 3.0]]), torch.tensor([quat_wxyz]))
    assert position_m.tolist() == [[-1.0, 2.0, 3.0]]
    torch.testing.assert_close(turned, torch.tensor([expected]))
