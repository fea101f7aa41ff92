"""Videos: frames of a file or a camera, one after the other, and their poses, each with the help of the one before."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import cv2
import numpy as np

from lightning_pose.errors import ConfigError, ImageError
from lightning_pose.geometry.absolute_pose import CameraPose
from lightning_pose.localization.located_pose import LocatedPose

if TYPE_CHECKING:
    from lightning_pose.geometry.camera import Camera
    from lightning_pose.localization.inputs import ImageInput
    from lightning_pose.localization.localizer import Localizer

__all__ = ["VideoFrame", "VideoReader", "VideoTracker"]

PRIOR_SECONDS = 0.3
"""An older pose says too little about where a hand-held camera is."""

USUAL_FPS = 30.0


class VideoFrame(NamedTuple):
    """A frame of a video.

    Attributes:
        pixels: (H, W, 3) uint8 RGB.
        name: `VIDEO#NUMBER`, counted from 0.
        time_s: since the first frame.
    """

    pixels: np.ndarray
    name: str
    time_s: float


class VideoReader:
    """Reads the frames of a video file, or of a camera of this computer, one at a time.

    Args:
        source: the file, or the camera's index.
        every: 1 reads all frames, 2 every second one, and so on.

    Raises:
        ConfigError: `every` is below 1.
        ImageError: it cannot be opened.
    """

    def __init__(self, source: str | Path | int, every: int = 1) -> None:
        if every < 1:
            raise ConfigError(f"every is {every}; give 1 for all frames, 2 for every second one, and so on")
        self.name = f"camera:{source}" if isinstance(source, int) else str(source)
        self._live = isinstance(source, int)
        self._every = every
        if not isinstance(source, int) and not Path(source).expanduser().is_file():
            raise ImageError(f"{source} does not exist; check the path of the video")
        self._capture = cv2.VideoCapture(source if isinstance(source, int) else str(Path(source).expanduser()))
        if not self._capture.isOpened():
            remedy = (
                "check its number, and that no other program uses it" if self._live else "convert it to MP4 (H.264)"
            )
            raise ImageError(f"{self.name} cannot be opened as a video; {remedy}")

    @property
    def count(self) -> int | None:
        """How many frames will be read, by what the file says of itself; None if that is unknown."""
        frames = int(self._capture.get(cv2.CAP_PROP_FRAME_COUNT))
        return None if self._live or frames <= 0 else -(-frames // self._every)

    def __iter__(self) -> Iterator[VideoFrame]:
        fps = self._capture.get(cv2.CAP_PROP_FPS) or USUAL_FPS
        number, started, shift = 0, 0.0, 0.0
        try:
            while self._capture.grab():
                now = time.monotonic() if self._live else self._capture.get(cv2.CAP_PROP_POS_MSEC) / 1000
                if number == 0:
                    started = now
                last, shift = shift, now - started
                if number and shift <= last:  # a file without times
                    shift = last + 1 / fps
                if number % self._every == 0:
                    found, pixels = self._capture.retrieve()
                    if found:
                        yield VideoFrame(cv2.cvtColor(pixels, cv2.COLOR_BGR2RGB), f"{self.name}#{number:06d}", shift)
                number += 1
        finally:
            self._capture.release()
        if number == 0:
            raise ImageError(f"{self.name} has no frame that can be decoded; convert it to MP4 (H.264)")


class VideoTracker:
    """Locates the frames of one video as they come.

    With a map, an accepted pose is the prior of the next frame, if that is at most 0.3 s later. A frame that the map
    refuses is lost: the next one is looked for in the whole map. A model of clips places each frame by the clip of
    the last frames that it ends; the world is the first camera. Networks locate each frame alone.

    Args:
        localizer: is not changed.
        camera: of all frames, for systems with a map; that of the training images if None.
    """

    def __init__(self, localizer: Localizer, camera: str | Camera | None = None) -> None:
        self._localizer = localizer
        self._camera = localizer.check_camera(camera)
        self._follow = localizer.system.start_clip() if localizer.system.clips is not None else None
        self._last: tuple[LocatedPose, float] | None = None

    def localize(self, image: ImageInput, time_s: float | None = None) -> LocatedPose:
        """Locate the next frame.

        Args:
            image: as for `Localizer.localize`.
            time_s: when it was taken, on any clock; by default 1/30 s after the last one.

        Raises:
            ConfigError: as `Localizer.localize`.
            ImageError: the same.
        """
        localizer = self._localizer
        started = time.perf_counter()
        loaded = localizer.load_image(image)
        read = time.perf_counter()
        if self._follow is not None:
            pose = self._follow(loaded)
        else:
            pose = localizer.locate_loaded(loaded, self._camera, self._find_prior(time_s))
        if time_s is None:
            time_s = 0.0 if self._last is None else self._last[1] + 1 / USUAL_FPS
        self._last = pose, time_s
        ended = time.perf_counter()
        times = {"read": 1e3 * (read - started), **pose.milliseconds, "total": 1e3 * (ended - started)}
        return replace(pose, time_s=time_s, milliseconds=times)

    def _find_prior(self, time_s: float | None) -> CameraPose | None:
        if self._last is None or self._localizer.system.view is None:
            return None
        pose, last = self._last
        if (
            not pose.accepted
            or pose.source != "map"
            or (time_s is not None and not 0 <= time_s - last <= PRIOR_SECONDS)
        ):
            return None
        matrix = pose.T_world_cam
        return CameraPose(matrix[:3, :3], matrix[:3, 3])
