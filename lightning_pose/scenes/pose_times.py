"""Poses at the times of the images, where a dataset has its poses as a trajectory with times of its own."""

from __future__ import annotations

import logging
from dataclasses import replace
from typing import Literal, get_args

import numpy as np

from lightning_pose.errors import ConfigError, DataError
from lightning_pose.geometry.interpolation import interpolate_poses
from lightning_pose.scenes.scene import Scene, Trajectory

__all__ = ["HOLE", "ClockOffsetSetting", "PoseTime", "check_pose_time", "interpolate_scene", "measure_hole"]

PoseTime = Literal["nearest", "interpolate"]
"""`nearest`: an image has the pose that the dataset gives it. `interpolate`: that of its own time between two poses."""

ClockOffsetSetting = float | Literal["auto"]
"""Milliseconds from an image's time to that of its pose, or `auto`: those that fit the training frames best."""

HOLE = 3.5
"""Poses this many usual steps apart have a hole between them, in which none are interpolated."""

LABEL = ", interpolated"

log = logging.getLogger("lightning_pose")


def check_pose_time(pose_time: str, clock_offset_ms: float | str) -> None:
    """Refuse settings that are not understood, or contradict each other.

    Raises:
        ConfigError: they are.
    """
    if pose_time not in get_args(PoseTime):
        raise ConfigError(f"data.pose_time is {pose_time!r}; give nearest or interpolate")
    if clock_offset_ms != "auto" and (isinstance(clock_offset_ms, str) or not np.isfinite(clock_offset_ms)):
        raise ConfigError(f"data.clock_offset_ms is {clock_offset_ms!r}; give milliseconds, such as -10, or auto")
    if pose_time == "nearest" and clock_offset_ms != 0:
        raise ConfigError(
            f"data.clock_offset_ms is {clock_offset_ms}, but data.pose_time is nearest, which does not use it; set "
            "interpolate"
        )


def measure_hole(trajectory: Trajectory) -> float:
    """Seconds between two poses from which on they have a hole between them; 0 for fewer than two times."""
    different = np.unique(trajectory.times_s)
    return HOLE * float(np.median(np.diff(different))) if len(different) > 1 else 0.0


def interpolate_scene(scene: Scene, offset_ms: float) -> Scene:
    """The scene with the poses of its trajectory at the images' times.

    Frames before, after and in holes of the trajectory are dropped with a warning.

    Args:
        scene: with or without splits; its poses may be interpolated already.
        offset_ms: from an image's time to that of its pose.

    Returns:
        the scene, whose ground truth is named with the offset: errors are under another truth than the given one.

    Raises:
        ConfigError: the dataset has a pose for each image, not a trajectory.
        DataError: no image has a time in the trajectory.
    """
    times = [frame.timestamp for frame in scene.frames if frame.timestamp is not None]
    if scene.trajectory is None or len(times) < len(scene.frames):
        raise ConfigError(
            f"data.pose_time is interpolate, but {scene.root} ({scene.format}) has no poses by time of one recording; "
            "set nearest"
        )
    hole_s = measure_hole(scene.trajectory)
    position_m, quats = interpolate_poses(*scene.trajectory, np.array(times) + offset_ms / 1000, hole_s)
    kept = np.isfinite(position_m[:, 0])
    if not kept.any():
        raise DataError(f"{scene.root}: no image lies within the times of the poses at {offset_ms:g} ms")
    if not kept.all():
        lost = len(kept) - int(kept.sum())
        log.warning("%s: dropped %d of %d images, no poses around their time", scene.root, lost, len(kept))
    frames = tuple(
        replace(frame, position_m=position_m[i], quat_wxyz=quats[i]) for i, frame in enumerate(scene.frames) if kept[i]
    )
    number = np.cumsum(kept) - 1
    splits = {split: number[indices[kept[indices]]] for split, indices in scene.splits.items()}
    label = scene.ground_truth.partition(LABEL)[0] + LABEL + (f" at {offset_ms:+g} ms" if offset_ms else "")
    return replace(scene, frames=frames, splits=splits, ground_truth=label)
