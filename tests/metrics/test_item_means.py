"""Means over items: of several processes each item counts once."""

from __future__ import annotations

import pytest
import torch

from lightning_pose.metrics.item_means import ItemMeans, key_items, key_poses, select_unique
from lightning_pose.metrics.pose_metrics import PoseMetrics

IDENTITY = torch.tensor([1.0, 0.0, 0.0, 0.0])


def test_keys_of_frames_and_of_clips() -> None:
    frames, clips = torch.tensor([3, 4, 3]), torch.tensor([[3, 4, 5], [4, 5, 6], [3, 4, 5]])
    assert select_unique(key_items(frames)).tolist() == [0, 1]
    assert select_unique(key_items(clips)).tolist() == [0, 1]
    # Frame 5 of the first clip and frame 5 of the second are two poses.
    assert len(select_unique(key_poses(clips).flatten())) == 6


def test_unknown_keys_all_count() -> None:
    assert select_unique(torch.tensor([-1, 7, -1, 7])).tolist() == [0, 1, 2]


def gather_twice(metric: ItemMeans | PoseMetrics) -> None:
    """Let a metric believe that two processes were given the same items."""
    metric.dist_sync_fn = lambda state, group: [state, state]
    metric.distributed_available_fn = lambda: True


def test_repeated_items_count_once() -> None:
    metric = ItemMeans()
    gather_twice(metric)
    metric.update({"total": torch.tensor([1.0, 2.0])}, torch.tensor([0, 1]))
    metric.update({"total": torch.tensor([6.0, 2.0])}, torch.tensor([2, 1]))
    assert metric.compute() == {"total": pytest.approx(3.0)}


def test_repeated_poses_count_once() -> None:
    metric = PoseMetrics()
    gather_twice(metric)
    position_hat = torch.tensor([[1.0, 0, 0], [0.0, 0, 0], [5.0, 0, 0], [5.0, 0, 0]])
    quat = IDENTITY.expand(4, 4)
    metric.update(position_hat, quat, torch.zeros(4, 3), quat, key_poses(torch.tensor([0, 1, 2, 2])))
    assert metric.compute()["position_mean_m"] == pytest.approx(2.0)
