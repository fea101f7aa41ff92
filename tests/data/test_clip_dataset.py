"""Clips: where they are cut, what they share, and how training varies them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from lightning_pose.data.batches import PoseBatch
from lightning_pose.data.clip_dataset import Augmentation, ClipDataset, ClipShape, find_runs, mirror_poses
from lightning_pose.errors import ConfigError, DataError
from lightning_pose.geometry.quaternions import orientation_error_deg, quat_normalize, quat_to_matrix
from lightning_pose.geometry.relative import relative_poses
from lightning_pose.scenes.scene import Frame, Scene

COUNT = 30


def data(count: int = COUNT) -> PoseBatch:
    """Frames whose only feature is their number, on a random walk."""
    generator = torch.Generator().manual_seed(0)
    quat_wxyz = quat_normalize(torch.randn(count, 4, generator=generator))
    return PoseBatch(
        torch.arange(count)[:, None].float(), torch.randn(count, 3, generator=generator), quat_wxyz, torch.arange(count)
    )


def clips(length: int = 4, augmentation: Augmentation | None = None, **shape: int) -> ClipDataset:
    """Clips of two runs of 15 frames."""
    return ClipDataset(data(), np.split(np.arange(COUNT), 2), ClipShape(length, **shape), augmentation=augmentation)


def scene(sequences: str) -> Scene:
    frames = [Frame(Path("x"), np.zeros(3), np.eye(4)[0], name, i) for i, name in enumerate(sequences)]
    return Scene("s", Path("s"), "none", tuple(frames))


@pytest.mark.parametrize(
    ("indices", "expected"),
    [
        (range(6), [[0, 1, 2], [3, 4, 5]]),
        ([0, 1, 4, 5], [[0, 1], [2, 3]]),
        ([0, 2, 3], [[0], [1], [2]]),
        ([], []),
    ],
)
def test_runs_end_where_a_sequence_or_the_split_does(indices: list[int], expected: list[list[int]]) -> None:
    assert [run.tolist() for run in find_runs(scene("aaabbb"), np.array(list(indices), int))] == expected


def test_the_first_gap_is_the_end_of_a_run() -> None:
    assert [run.tolist() for run in find_runs(scene("aaaaaa"), np.array([0, 1, 3, 4, 5]))] == [[0, 1], [2, 3, 4]]


@pytest.mark.parametrize(
    ("shape", "frames", "starts"),
    [
        (ClipShape(4), 10, [0, 3, 6]),
        (ClipShape(4), 12, [0, 3, 6, 8]),
        (ClipShape(4, hop=1), 6, [0, 1, 2]),
        (ClipShape(3, stride=2), 9, [0, 4]),
        (ClipShape(4), 4, [0]),
        (ClipShape(4), 3, []),
    ],
)
def test_where_clips_begin(shape: ClipShape, frames: int, starts: list[int]) -> None:
    assert shape.starts(frames) == starts


def test_a_clip_is_of_consecutive_frames_of_one_run_and_all_frames_are_in_one() -> None:
    batch = clips().__getitems__(range(len(clips())))
    assert batch.features.shape == (len(clips()), 4, 1)
    assert (batch.frame.diff(dim=1) == 1).all()
    assert ((batch.frame // 15).amin(1) == (batch.frame // 15).amax(1)).all()
    assert set(batch.frame.flatten().tolist()) == set(range(COUNT))
    torch.testing.assert_close(batch.features[..., 0], batch.frame.float())


def test_poses_are_relative_to_the_first_frame() -> None:
    dataset = clips(stride=2)
    batch = dataset[1]
    rows = batch.frame
    assert rows.tolist() == [6, 8, 10, 12]
    expected = relative_poses(dataset.data.position_m[rows], dataset.data.quat_wxyz[rows])
    torch.testing.assert_close(batch.position_m, expected[0])
    torch.testing.assert_close(batch.quat_wxyz, expected[1])
    torch.testing.assert_close(dataset.targets()[0][1], expected[0])


def test_without_augmentation_clips_stay_the_same() -> None:
    assert torch.equal(clips()[2].frame, clips()[2].frame)


def test_wandering_clips_begin_anew_and_never_leave_their_run() -> None:
    dataset = clips(augmentation=Augmentation(wander=True))
    drawn = torch.stack([dataset.__getitems__(range(len(dataset))).frame for _ in range(50)])
    assert (drawn.diff(dim=2) == 1).all()
    assert ((drawn // 15).amin(2) == (drawn // 15).amax(2)).all()
    for clip, start in enumerate(dataset.rows()[:, 0].tolist()):
        begins = set(drawn[:, clip, 0].tolist())
        assert begins <= set(range(start, start + 3))
    assert set(drawn[:, 0, 0].tolist()) == {0, 1, 2}


def test_faster_clips_skip_frames_as_far_as_the_run_goes() -> None:
    dataset = clips(augmentation=Augmentation(max_stride=3))
    drawn = torch.stack([dataset.__getitems__(range(len(dataset))).frame for _ in range(60)])
    strides = drawn.diff(dim=2)
    assert (strides == strides[..., :1]).all(), "a clip has one stride"
    assert set(strides[:, 0].flatten().tolist()) == {1, 2, 3}
    assert set(strides[:, 3].flatten().tolist()) == {1}, "the clip at the end of the run has no room"
    assert ((drawn // 15).amin(2) == (drawn // 15).amax(2)).all()


def test_reversed_clips_have_the_poses_of_the_way_back() -> None:
    dataset = clips(augmentation=Augmentation(reverse=True))
    drawn = [dataset[0] for _ in range(30)]
    assert {tuple(batch.frame.tolist()) for batch in drawn} == {(0, 1, 2, 3), (3, 2, 1, 0)}
    for batch in drawn:
        rows = batch.frame
        expected = relative_poses(dataset.data.position_m[rows], dataset.data.quat_wxyz[rows])
        torch.testing.assert_close(batch.position_m, expected[0])


def test_mirrored_poses_are_those_of_the_mirrored_world() -> None:
    position_m, quat_wxyz = data(5).position_m, data(5).quat_wxyz
    mirror = torch.diag(torch.tensor([-1.0, 1, 1]))
    mirrored = mirror_poses(position_m, quat_wxyz)
    torch.testing.assert_close(mirrored[0], position_m @ mirror)
    torch.testing.assert_close(quat_to_matrix(mirrored[1]), mirror @ quat_to_matrix(quat_wxyz) @ mirror)
    # A point straight ahead and to the right of a camera is to the left of the mirrored one.
    point = torch.tensor([1.0, 2, 3])
    seen = (quat_to_matrix(quat_wxyz).mT @ (point - position_m)[..., None])[..., 0]
    seen_mirrored = (quat_to_matrix(mirrored[1]).mT @ (point @ mirror - mirrored[0])[..., None])[..., 0]
    torch.testing.assert_close(seen_mirrored, seen @ mirror)


def test_half_of_the_clips_are_mirrored_with_their_features() -> None:
    dataset = clips(augmentation=Augmentation(mirror=torch.neg))
    drawn = [dataset[1] for _ in range(40)]
    turned = [bool((batch.features < 0).any()) for batch in drawn]
    assert 5 < sum(turned) < 35
    plain = clips()[1]
    for batch, is_turned in zip(drawn, turned, strict=True):
        expected = mirror_poses(plain.position_m, plain.quat_wxyz) if is_turned else plain[1:3]
        torch.testing.assert_close(batch.position_m, expected[0])
        assert orientation_error_deg(batch.quat_wxyz, expected[1]).max() < 1e-3
    assert torch.equal(dataset.data.features, data().features), "the shared frames stay as they are"


def test_frames_are_shared() -> None:
    dataset = clips(hop=1)
    assert len(dataset) == 24
    assert len(dataset.data.features) == COUNT


@pytest.mark.parametrize(("settings", "message"), [
    ({"length": 1}, "clip_length is 1; give 2 frames or more"),
    ({"length": 3, "stride": 0}, "stride is 0; give 1 frame or more"),
    ({"length": 3, "hop": 0}, "hop is 0; give 1 frame or more"),
])  # fmt: skip
def test_shapes_that_cannot_be_are_refused(settings: dict[str, int], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        ClipShape(**settings)


def test_a_clip_longer_than_every_run_is_refused() -> None:
    with pytest.raises(DataError, match=r"8 frames with stride 3 spans 22 frames, but the longest run .* has 15"):
        clips(8, stride=3)


def test_short_runs_are_left_out_with_a_warning(caplog: pytest.LogCaptureFixture) -> None:
    dataset = ClipDataset(data(), [np.arange(10), np.arange(10, 13), np.arange(13, 30)], ClipShape(5))
    assert not {10, 11, 12} & set(dataset.rows().flatten().tolist())
    assert "1 of 3 runs of frames are shorter than a clip (5) and left out" in caplog.text
