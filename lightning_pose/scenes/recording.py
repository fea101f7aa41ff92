"""What in a recording misleads without a word: repeated images, another camera's poses, another unit than metres."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from lightning_pose.scenes.gaps import find_run_starts
from lightning_pose.scenes.scene import Scene

__all__ = ["describe_pose_camera", "inspect_recording"]

MAX_SPEED_M_S = 60.0
"""A camera that usually moves faster than this is not measured in metres and seconds."""


def inspect_recording(scene: Scene, digests: Sequence[bytes]) -> list[str]:
    """Warnings about a scene's recording, in words.

    Args:
        scene: the dataset.
        digests: of each frame's image file; empty where it cannot be read.
    """
    found = _describe_repeats(scene, digests), _describe_speed(scene)
    return [text for text in found if text]


def _describe_repeats(scene: Scene, digests: Sequence[bytes]) -> str:
    """How many frames repeat the image of the frame before them, and how many of these have another pose."""
    frames = scene.frames
    repeats, moved, longest, run = 0, 0, 1, 1
    for i in range(1, len(frames)):
        same = digests[i] and digests[i] == digests[i - 1] and frames[i].sequence == frames[i - 1].sequence
        run = run + 1 if same else 1
        longest = max(longest, run)
        if same:
            repeats += 1
            moved += bool((frames[i].position_m != frames[i - 1].position_m).any())
    if not repeats:
        return ""
    return (
        f"{repeats} frames repeat the image of the frame before them, up to {longest} in a row, and {moved} of them "
        "with another pose; a camera or a converter has repeated frames, and one image has no two poses"
    )


def _describe_speed(scene: Scene) -> str:
    """That the camera usually moves faster than any vehicle; where frames have times and metres."""
    times = [frame.timestamp for frame in scene.frames if frame.timestamp is not None]
    if len(times) < max(len(scene.frames), 2) or scene.unit != "m":
        return ""
    seconds = np.diff(times)
    steps_m = np.linalg.norm(np.diff([frame.position_m for frame in scene.frames], axis=0), axis=1)
    kept = ~find_run_starts(scene)[1:] & (seconds > 0)
    speed = float(np.median(steps_m[kept] / seconds[kept])) if kept.any() else 0.0
    if speed <= MAX_SPEED_M_S:
        return ""
    return (
        f"the camera moves at {speed:.3g} m/s (median), faster than any vehicle; check the unit of the positions "
        "(millimetres?) and of the times"
    )


def describe_pose_camera(scene: Scene) -> list[str]:
    """That the format's poses are those of another camera than the images', which no image shows; else nothing."""
    if scene.format != "7scenes" or scene.ground_truth != "original":
        return []
    return [
        "7-Scenes' published poses are those of its depth camera, 25.5 mm and 0.67 deg beside the colour camera that "
        "took the images; if these are published files, data.ground_truth=registered moves them"
    ]
