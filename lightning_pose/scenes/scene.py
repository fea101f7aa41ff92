"""`Scene`: posed frames and their splits, into which every dataset is read."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import numpy as np

__all__ = ["SPLITS", "Frame", "Intrinsics", "Scene", "Trajectory"]

SPLITS = ("train", "val", "test")


@dataclass(frozen=True)
class Intrinsics:
    """A camera, in pixels; the centre of the first pixel is (0, 0).

    Attributes:
        fx: focal length across.
        fy: focal length down.
        cx: principal point.
        cy: principal point.
        size: width and height of the images that the numbers are for; None for the images as they are.
        distortion: OpenCV's coefficients k1 k2 p1 p2 k3 ..., or with `fisheye` k1 k2 k3 k4 or those of another lens, as
            `Camera` has them; empty for none.
        fisheye: whether the distortion is that of a fisheye lens (equidistant).
    """

    fx: float
    fy: float
    cx: float
    cy: float
    size: tuple[int, int] | None = None
    distortion: tuple[float, ...] = ()
    fisheye: bool = False

    def for_size(self, width: int, height: int) -> Intrinsics:
        """The same camera for images that were resized to this size."""
        if self.size is None or self.size == (width, height):
            return self
        x, y = width / self.size[0], height / self.size[1]
        cx, cy = (self.cx + 0.5) * x - 0.5, (self.cy + 0.5) * y - 0.5
        return Intrinsics(self.fx * x, self.fy * y, cx, cy, (width, height), self.distortion, self.fisheye)


@dataclass(frozen=True)
class Frame:
    """One posed image.

    Attributes:
        image: path of the image file.
        position_m: (3,) float64, the camera centre in the world, metres (or the scene's unit).
        quat_wxyz: (4,) float64, unit Hamilton quaternion, camera-to-world, OpenCV axes.
        sequence: name of the trajectory the frame belongs to.
        index: position of the frame in its sequence, as the dataset numbers it.
        timestamp: seconds; None if the dataset has none.
        intrinsics: the camera; None if the format does not give it.
    """

    image: Path
    position_m: np.ndarray
    quat_wxyz: np.ndarray
    sequence: str
    index: int
    timestamp: float | None = None
    intrinsics: Intrinsics | None = None


class Trajectory(NamedTuple):
    """Poses as a function of time, more or others than the images have; see `geometry.interpolation`.

    Attributes:
        times_s: (N,) on the clock of the poses, which should be that of the frames' timestamps; in any order.
        positions_m: (N, 3), as those of frames.
        quats_wxyz: (N, 4), as those of frames.
    """

    times_s: np.ndarray
    positions_m: np.ndarray
    quats_wxyz: np.ndarray


@dataclass(frozen=True)
class Scene:
    """Every frame of one place, and which frames are for training, validation and test.

    Attributes:
        name: short name of the scene, the folder's name.
        root: the folder it was read from.
        format: name of the adapter that read it.
        frames: every frame; those of one sequence are consecutive and in order.
        splits: frame indices of each of `SPLITS`; disjoint.
        split_source: `official` if the dataset has a split, `blocks` if the trajectory was cut into blocks, `unseen` if
            no frame of the test scenes is trained on; otherwise the user's rule, as in `apply_split_rule`.
        unit: unit of the positions: `m`, or `scene` if the scale is arbitrary.
        ground_truth: where the poses come from (`original`, `sfm`, `synthetic`, ...).
        bad_frames: what is wrong with each frame that the dataset lists and that is not in `frames`; each text begins
            with the file, and the line where there are several.
        trajectory: all sound poses of the dataset, where it has them by time, whether or not a frame has their time.
    """

    name: str
    root: Path
    format: str
    frames: tuple[Frame, ...]
    splits: Mapping[str, np.ndarray] = field(default_factory=dict)
    split_source: str = "official"
    unit: str = "m"
    ground_truth: str = "original"
    bad_frames: tuple[str, ...] = ()
    trajectory: Trajectory | None = None
