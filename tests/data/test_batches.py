"""Batches: one gather for a whole batch, equal to collating frame by frame."""

from __future__ import annotations

import torch

from lightning_pose.data.batches import DrawnDataset, PoseBatch, PoseDataset, make_loader


def dataset(count: int = 10) -> PoseDataset:
    n = torch.arange(count)
    features = n[:, None, None].expand(count, 3, 4).float()
    return PoseDataset(PoseBatch(features, n[:, None] * torch.ones(3), n[:, None] * torch.ones(4), n + 100))


def test_one_frame_and_many() -> None:
    frames = dataset()
    assert len(frames) == 10
    assert frames[3].frame == 103
    batch = frames.__getitems__([7, 2])
    assert batch.frame.tolist() == [107, 102]
    assert batch.features.shape == (2, 3, 4)
    torch.testing.assert_close(batch.position_m, torch.stack([frames[7].position_m, frames[2].position_m]))


def test_a_loader_in_order() -> None:
    batches = list(make_loader(dataset(), 4, shuffle=False))
    assert [len(batch.frame) for batch in batches] == [4, 4, 2]
    assert torch.cat([batch.frame for batch in batches]).tolist() == list(range(100, 110))
    assert all(isinstance(batch, PoseBatch) for batch in batches)


def test_a_shuffled_loader_has_every_frame_once_and_its_own_pose() -> None:
    torch.manual_seed(0)
    batches = list(make_loader(dataset(), 4, shuffle=True))
    frame = torch.cat([batch.frame for batch in batches])
    assert frame.tolist() != sorted(frame.tolist())
    assert sorted(frame.tolist()) == list(range(100, 110))
    position_m = torch.cat([batch.position_m for batch in batches])
    torch.testing.assert_close(position_m[:, 0], (frame - 100).float())


def test_a_draw_takes_other_features_each_time_in_their_order() -> None:
    torch.manual_seed(0)
    row = torch.arange(20).float()
    features = (100 * torch.arange(4)[:, None] + row)[..., None].expand(4, 20, 3)  # frame * 100 + row, in 3 columns
    data = DrawnDataset(PoseBatch(features, torch.zeros(4, 3), torch.zeros(4, 4), torch.arange(4)), n_features=5)
    first, second = data.__getitems__([2, 0]), data.__getitems__([2, 0])
    assert first.features.shape == (2, 5, 3)
    assert torch.all(first.features.diff(dim=1) > 0)
    assert (first.features[:, :, 0] // 100).unique(dim=1).flatten().tolist() == [2, 0]
    assert not torch.equal(first.features, second.features)
    assert data[3].features.shape == (5, 3)
