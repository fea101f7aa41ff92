"""Reads the frames of video files, and writes some of them as images."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from pathlib import Path

import cv2
import numpy as np

from lightning_pose.errors import DataError
from lightning_pose.paths import replace_file

__all__ = ["VIDEO_SUFFIXES", "name_frame", "read_frame_rate", "read_video", "write_frames"]

VIDEO_SUFFIXES = (".mp4", ".avi", ".mov", ".mkv", ".webm", ".m4v", ".mpg", ".mpeg", ".wmv", ".3gp")
JPEG_QUALITY = 95


def name_frame(number: int) -> str:
    """The file name of a frame of a video, counted from 0.

    >>> name_frame(7)
    'frame_000007.jpg'
    """
    return f"frame_{number:06d}.jpg"


def read_frame_rate(path: Path) -> float:
    """Frames a second, as the file says.

    Raises:
        DataError: it is no video, or does not say.
    """
    capture = cv2.VideoCapture(str(path))
    rate = capture.get(cv2.CAP_PROP_FPS) if capture.isOpened() else 0.0
    capture.release()
    if not 0 < rate < 10_000:
        raise DataError(f"{path} does not say how many frames a second it has; {_give_remedy(path)}")
    return float(rate)


def read_video(path: Path) -> Iterator[np.ndarray]:
    """All frames of a video, (H, W, 3) uint8 BGR, upright.

    Raises:
        DataError: no frame can be read.
    """
    capture = cv2.VideoCapture(str(path))
    try:
        count = 0
        while True:
            found, frame = capture.read()
            if not found:
                break
            count += 1
            yield frame
        if not count:
            raise DataError(f"{path} is no video that OpenCV reads; {_give_remedy(path)}")
    finally:
        capture.release()


def write_frames(path: Path, numbers: Collection[int], folder: Path) -> Iterator[Path]:
    """Write frames of a video as JPEG files, and yield these one by one; files that are there already stay.

    Args:
        path: the video.
        numbers: of frames, counted from 0; those after its end are left out.
        folder: is made if it is missing.

    Raises:
        DataError: no frame can be read.
    """
    files = {number: folder / name_frame(number) for number in sorted(numbers)}
    missing = [number for number, file in files.items() if not file.exists()]
    frames = enumerate(read_video(path)) if missing else iter(())
    for number, file in files.items():
        if not file.exists():
            frame = next((frame for i, frame in frames if i == number), None)
            if frame is None:
                return
            data = cv2.imencode(".jpg", frame, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])[1].tobytes()
            replace_file(file, data, file.with_suffix(".tmp"))
        yield file


def _give_remedy(path: Path) -> str:
    return f"convert it, such as with `ffmpeg -i {path.name} video.mp4`, or give a folder of images"
