"""Videos: frames of a file one after the other, each located with the pose before it as prior."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from lightning_pose.errors import ConfigError, ImageError
from lightning_pose.localization.localizer import Localizer
from lightning_pose.localization.video import VideoReader, VideoTracker
from tests.rooms import MappedRoom, write_video


@pytest.fixture(scope="module")
def localizer(mapped_room: MappedRoom) -> Localizer:
    return Localizer.load(mapped_room.checkpoint)


def test_a_camera_that_jumps_is_lost_for_one_frame(localizer: Localizer, mapped_room: MappedRoom) -> None:
    """The prior is checked: a pose far from the last one is refused once, then looked for in the whole map."""
    first = localizer.localize(mapped_room.images[0])
    tracker = VideoTracker(localizer)
    assert tracker.localize(mapped_room.read(0)).accepted
    far = max(
        sorted((mapped_room.root / "seq-01").glob("*.color.*")),
        key=lambda path: _distance(localizer, path, first.position_m),
    )
    jumped, settled = tracker.localize(far), tracker.localize(far)
    assert jumped.reason.startswith("contradicts the prior")
    assert settled.accepted
    # Later than 0.3 s, a camera may be anywhere.
    assert tracker.localize(mapped_room.read(0), time_s=60.0).accepted


def _distance(localizer: Localizer, path: Path, position_m: np.ndarray) -> float:
    return float(np.linalg.norm(localizer.localize(path).position_m - position_m))


def test_a_video_file(localizer: Localizer, mapped_room: MappedRoom, tmp_path: Path) -> None:
    video = write_video(tmp_path / "walk.avi", [mapped_room.read(i) for i in range(6)])
    found = localizer.localize(str(video))
    assert isinstance(found, Iterator)
    poses = list(found)
    assert [pose.image for pose in poses] == [f"{video}#{i:06d}" for i in range(6)]
    assert [pose.time_s for pose in poses] == pytest.approx([0.1 * i for i in range(6)], abs=1e-6)
    errors = [
        np.linalg.norm(pose.position_m - truth) for pose, truth in zip(poses, mapped_room.position_m, strict=False)
    ]
    assert np.median(errors) < 0.04
    assert VideoReader(video, every=4).count == 2
    assert [pose.time_s for pose in localizer.localize_video(video, every=4)] == pytest.approx([0.0, 0.4], abs=1e-6)
    with pytest.raises(ConfigError, match="leave prior out"):
        localizer.localize(str(video), prior=poses[0])
    with pytest.raises(ConfigError, match="every is 0"):
        VideoReader(video, every=0)


def test_what_is_no_video(localizer: Localizer, tmp_path: Path) -> None:
    (tmp_path / "walk.mp4").write_bytes(b"no video")
    with pytest.raises(ImageError, match=r"walk.mp4 cannot be opened as a video; convert it to MP4"):
        list(localizer.localize_video(tmp_path / "walk.mp4"))
    with pytest.raises(ImageError, match=r"none.mp4 does not exist"):
        list(localizer.localize_video(tmp_path / "none.mp4"))
    with pytest.raises(ImageError, match=r"camera:97 cannot be opened as a video; check its number"):
        list(localizer.localize_video(97))
