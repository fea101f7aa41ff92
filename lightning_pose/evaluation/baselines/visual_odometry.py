"""Classical visual odometry: each step from matched SIFT features of two frames, chained along a clip."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TimeRemainingColumn
from torch import Tensor

from lightning_pose.errors import ConfigError
from lightning_pose.features.fill_job import count_cores
from lightning_pose.features.matching import match_descriptors
from lightning_pose.features.opencv import SIFT
from lightning_pose.geometry.quaternions import quat_rotate
from lightning_pose.geometry.relative import RelativeFrame, chain_steps, check_relative_frame
from lightning_pose.geometry.two_view import MIN_INLIERS, two_view_motion
from lightning_pose.scenes.scene import Frame, Intrinsics

__all__ = [
    "Motion",
    "View",
    "assume_intrinsics",
    "describe_frame",
    "match_motion",
    "read_clip_poses",
    "run_visual_odometry",
]

N_FEATURES = 1000

FOCAL_PER_SIDE = 525 / 640
"""Focal length by the image's longer side, where a dataset does not give the camera: that of 7-Scenes' Kinect."""

CHUNK = 8  # steps that a worker gets at a time, which bounds how many images' features are held


@dataclass(frozen=True)
class View:
    """The features of an image that odometry matches.

    Attributes:
        points: (N, 2) float64 in normalised image coordinates, (pixel - centre) / focal length.
        descriptors: (N, D) float32, L2-normalised.
        focal_px: pixels to one normalised unit.
    """

    points: np.ndarray
    descriptors: np.ndarray
    focal_px: float


@dataclass(frozen=True)
class Motion:
    """Poses relative to the first frame of each clip, and how many steps they are made of.

    Attributes:
        position_m: (B, T, 3) float64.
        quat_wxyz: (B, T, 4) float64, unit, w >= 0.
        failed_steps: steps without motion because `two_view_motion` found none.
        steps: distinct steps, however many clips share them.
    """

    position_m: Tensor
    quat_wxyz: Tensor
    failed_steps: int
    steps: int


def run_visual_odometry(
    frames: Sequence[Frame],
    clips: np.ndarray | Tensor,
    relative_frame: RelativeFrame = "camera",
    progress: bool = True,
    workers: int | None = None,
) -> Motion:
    """A baseline for models of clips: two-frame odometry from images alone, without learning or a map.

    Images of one camera do not determine scale, so **each step's length is taken from the truth**; only its direction
    and rotation are estimated. A step that fails (`two_view_motion`) has no motion. In `world` axes, the positions are
    turned by the clip's **true first orientation**, which images do not give either.

    Each image is described once, and each pair of frames that are neighbours in some clip is matched once. Where the
    dataset does not give the camera, `assume_intrinsics` does.

    Args:
        frames: with their true poses.
        clips: (B, T) indices into frames, T >= 1.
        relative_frame: axes of the positions, as for `relative_poses`.
        progress: show a bar on stderr.
        workers: threads; by default one for each core this process may use.

    Raises:
        ConfigError: clips that are not (B, T) indices into frames, or an unknown relative_frame.
        ImageError: an image cannot be read.
    """
    check_relative_frame(relative_frame)
    rows = _check_clips(clips, len(frames))
    neighbours = np.stack([rows[:, :-1], rows[:, 1:]], axis=-1)
    unique, which = np.unique(neighbours.reshape(-1, 2), axis=0, return_inverse=True)
    pairs: list[tuple[int, int]] = [(int(a), int(b)) for a, b in unique]
    found = _estimate_steps(frames, pairs, workers or count_cores(), progress)
    step_position, step_quat = torch.zeros(len(pairs), 3).double(), torch.eye(4)[:1].double().repeat(len(pairs), 1)
    for number, ((a, b), motion) in enumerate(zip(pairs, found, strict=True)):
        if motion is not None:
            length = float(np.linalg.norm(frames[b].position_m - frames[a].position_m))
            step_position[number], step_quat[number] = motion[0] * length, motion[1]
    which = torch.from_numpy(which.reshape(neighbours.shape[:2]))
    position_m, quat_wxyz = chain_steps(step_position[which], step_quat[which])
    if relative_frame == "world":
        position_m = quat_rotate(read_clip_poses(frames, rows[:, :1])[1], position_m)
    failed = sum(motion is None for motion in found)
    return Motion(position_m, quat_wxyz, failed, len(pairs))


def read_clip_poses(frames: Sequence[Frame], clips: np.ndarray | Tensor) -> tuple[Tensor, Tensor]:
    """True position_m (B, T, 3) and quat_wxyz (B, T, 4) in the world, float64, of (B, T) indices into frames.

    Raises:
        ConfigError: as `run_visual_odometry`.
    """
    rows = torch.from_numpy(_check_clips(clips, len(frames)))
    position_m = torch.from_numpy(np.array([frame.position_m for frame in frames], np.float64))
    quat_wxyz = torch.from_numpy(np.array([frame.quat_wxyz for frame in frames], np.float64))
    return position_m.view(-1, 3)[rows], quat_wxyz.view(-1, 4)[rows]


def _estimate_steps(
    frames: Sequence[Frame], pairs: list[tuple[int, int]], workers: int, progress: bool
) -> list[tuple[Tensor, Tensor] | None]:
    """`match_motion` of each pair, in order; an image's features are kept from its first pair to its last."""
    last_use = {image: number for number, pair in enumerate(pairs) for image in pair}
    views: dict[int, View] = {}
    size, found = CHUNK * workers, []
    with (
        _open_progress(progress and len(pairs) > 0) as bar,
        _limit_opencv_threads(),
        ThreadPoolExecutor(workers) as pool,
    ):
        task = bar.add_task("visual odometry", total=len(pairs))
        for start in range(0, len(pairs), size):
            chunk = pairs[start : start + size]
            new = sorted({image for pair in chunk for image in pair} - views.keys())
            views.update(zip(new, pool.map(describe_frame, [frames[image] for image in new]), strict=True))
            for motion in pool.map(_estimate_step, [(views[a], views[b]) for a, b in chunk]):
                found.append(motion)
                bar.advance(task)
            views = {image: view for image, view in views.items() if last_use[image] >= start + size}
    return found


def _estimate_step(views: tuple[View, View]) -> tuple[Tensor, Tensor] | None:
    """`match_motion` of two views; no motion between a view and itself."""
    if views[0] is views[1]:  # a frame repeated has not moved, which is no failure
        return torch.zeros(3).double(), torch.eye(4)[0].double()
    return match_motion(*views)


def match_motion(a: View, b: View) -> tuple[Tensor, Tensor] | None:
    """`two_view_motion` of the matches of two views; None where a view has too few features."""
    if len(a.points) < MIN_INLIERS or len(b.points) < MIN_INLIERS:
        return None
    rows_a, rows_b = match_descriptors(a.descriptors, b.descriptors)
    return two_view_motion(a.points[rows_a], b.points[rows_b], 0.5 * (a.focal_px + b.focal_px))


def describe_frame(frame: Frame) -> View:
    """Extract an image's SIFT features, in normalised coordinates.

    Raises:
        ImageError: the image cannot be read.
    """
    sift = SIFT(N_FEATURES)
    record = sift.extract([sift.read(frame.image)])[0]
    count = int(record["count"])
    width, height = record["image_size"].tolist()
    camera = frame.intrinsics.for_size(width, height) if frame.intrinsics else assume_intrinsics(width, height)
    pixels = record["keypoints"][:count, :2].astype(np.float64)
    points = (pixels - [camera.cx, camera.cy]) / [camera.fx, camera.fy]
    return View(points, record["descriptors"][:count], 0.5 * (camera.fx + camera.fy))


def assume_intrinsics(width: int, height: int) -> Intrinsics:
    """The camera of an image of unknown origin: `FOCAL_PER_SIDE` of the longer side, and the centre in the middle."""
    focal = FOCAL_PER_SIDE * max(width, height)
    return Intrinsics(focal, focal, width / 2, height / 2)


def _check_clips(clips: np.ndarray | Tensor, total: int) -> np.ndarray:
    """(B, T) int64, T >= 1, all within 0..total-1."""
    rows = np.asarray(clips)
    if rows.ndim != 2 or rows.shape[1] < 1 or not np.issubdtype(rows.dtype, np.integer):
        raise ConfigError(f"clips are {rows.dtype} of shape {rows.shape}; give (B, T) whole numbers, T at least 1")
    if rows.size and not 0 <= rows.min() <= rows.max() < total:
        raise ConfigError(f"clips name frames {rows.min()} to {rows.max()}; there are {total}, numbered from 0")
    return rows.astype(np.int64)


@contextmanager
def _limit_opencv_threads() -> Iterator[None]:
    """Keep OpenCV from starting further threads in each worker thread."""
    before = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        yield
    finally:
        cv2.setNumThreads(before)


def _open_progress(shown: bool) -> Progress:
    """A progress bar on stderr; disabled where it is not to be shown."""
    columns = "{task.description}", BarColumn(), MofNCompleteColumn(), TimeRemainingColumn()
    return Progress(*columns, console=Console(stderr=True), disable=not shown)
