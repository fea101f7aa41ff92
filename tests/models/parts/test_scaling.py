"""Scales: known values, and which frames they are measured on."""

from __future__ import annotations

import torch

from lightning_pose.models.parts import scaling
from lightning_pose.models.parts.scaling import measure_columns, measure_poses


def test_a_position_and_a_quaternion_have_one_spread_each() -> None:
    position_m = torch.tensor([[1.0, 0.0, 0.0], [3.0, 0.0, 0.0]])
    quat_wxyz = torch.tensor([[1.0, 0.0, 0.0, 0.0], [-1.0, 0.0, 0.0, 0.0]])
    mean, spread = measure_poses(position_m, quat_wxyz, torch.tensor([1.0, 0.0, 0.0, 0.0]))
    torch.testing.assert_close(mean, torch.tensor([2.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0]))
    torch.testing.assert_close(spread, torch.tensor([(1 / 3) ** 0.5] * 3 + [scaling.SMALLEST] * 4))


def test_columns_lie_on_any_axis() -> None:
    features = torch.randn(20, 3, 4, 5, generator=torch.Generator().manual_seed(0))
    for axis in (-1, -2, -3):
        found = measure_columns(features, axis)
        assert found is not None
        rows = features.movedim(axis, -1).flatten(0, -2)
        torch.testing.assert_close(found[0], rows.mean(0))
        torch.testing.assert_close(found[1], rows.std(0))


def test_too_few_rows_have_no_scale() -> None:
    assert measure_columns(torch.tensor([[1.0, 2.0], [0.0, 0.0]]), -1) is None


def test_a_thousand_frames_of_many_are_measured() -> None:
    features = torch.arange(4000.0)[:, None] + 1
    found = measure_columns(features, -1)
    assert found is not None
    torch.testing.assert_close(found[0], features[::4].mean(0))
