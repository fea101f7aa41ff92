"""Videos and folders of images as a source of frames."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from lightning_pose.errors import DataError
from lightning_pose.reconstruction.source import open_source
from lightning_pose.scenes.images import read_gray
from tests.data.helpers import make_image
from tests.scenes.formats.test_trajectory import write_video


def test_images_come_in_natural_order_without_depth(tmp_path: Path) -> None:
    for name in ("b/10.png", "b/9.png", "a/1.jpg", "b/9.depth.png", "depth/9.png", ".hidden.png"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        cv2.imwrite(str(tmp_path / name), np.zeros((8, 8), np.uint8))
    source = open_source(tmp_path)
    assert source.list_names(9) == ["a/1.jpg", "b/9.png", "b/10.png"]
    out = tmp_path / "out"
    assert list(source.write([2, 0], out)) == ["a/1.jpg", "b/10.png"]
    assert (out / "b/10.png").read_bytes() == (tmp_path / "b/10.png").read_bytes()
    assert len(list(source.read_gray())) == 3


def test_frames_of_a_video_are_written_once(tmp_path: Path) -> None:
    video = tmp_path / "walk.avi"
    write_video(video, 6)
    source = open_source(video)
    assert (source.is_video, source.count, len(list(source.read_gray()))) == (True, 6, 6)
    out = tmp_path / "out"
    assert list(source.write([1, 4], out)) == ["frame_000001.jpg", "frame_000004.jpg"]
    (out / "frame_000001.jpg").write_bytes(b"kept")
    assert list(source.write([1, 2, 4], out)) == ["frame_000001.jpg", "frame_000002.jpg", "frame_000004.jpg"]
    assert (out / "frame_000001.jpg").read_bytes() == b"kept"
    np.testing.assert_allclose([read_gray(out / f"frame_00000{i}.jpg").mean() for i in (2, 4)], [60, 100], atol=4)


def test_what_is_no_source(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="does not exist; give a video file"):
        open_source(tmp_path / "nothing.mp4")
    (tmp_path / "empty").mkdir()
    with pytest.raises(DataError, match="holds no image"):
        open_source(tmp_path / "empty")
    make_image(tmp_path / "a.png")
    with pytest.raises(DataError, match="is one image"):
        open_source(tmp_path / "a.png")
    (tmp_path / "text.mp4").write_text("no video")
    with pytest.raises(DataError, match="is no video that OpenCV reads; convert it"):
        list(open_source(tmp_path / "text.mp4").read_gray())
