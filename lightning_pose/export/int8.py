"""Weights in 8 bits, kept only where the poses stay as accurate."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from lightning_pose.errors import ConfigError
from lightning_pose.export.agreement import locate_images
from lightning_pose.export.frames import CheckFrames
from lightning_pose.export.quantize import quantize_file
from lightning_pose.export.runner.system import ExportedSystem
from lightning_pose.localization.localizer import Localizer

__all__ = ["shrink_network"]

MOST_WORSE = 0.05
"""By which share the median error on frames with known poses may grow."""


MOST_BYTES = 0.9
"""Share of its bytes that a network may keep; a smaller gain is not worth another file."""


def shrink_network(folder: Path, network: str, frames: CheckFrames) -> Mapping[str, Any]:
    """Replace a folder's network by one of 8-bit weights.

    Args:
        folder: complete.
        network: name of the network's file.
        frames: with their poses.

    Returns:
        errors before and after, for `localizer.json`.

    Raises:
        ConfigError: the poses of the frames are not known, other frames are accepted, or errors grow too much.
    """
    if frames.position_m is None or frames.quat_wxyz is None:
        raise ConfigError(
            "--int8 is measured on frames with known poses; leave --images out, and give --root if needed"
        )
    before, accepted = measure_errors(folder, frames)
    whole, small = folder / network, folder / f"{network}.int8"
    quantize_file(whole, small)
    size = small.stat().st_size / whole.stat().st_size
    if size > MOST_BYTES:
        raise ConfigError(
            f"--int8 leaves {size:.0%} of the network's bytes: its largest arrays are not weights of 32 bits; "
            "leave it out"
        )
    small.replace(whole)
    after, accepted_after = measure_errors(folder, frames)
    facts = {
        "frames": len(frames.images),
        "split": frames.split,
        "median_m": [float(before[0]), float(after[0])],
        "median_deg": [float(before[1]), float(after[1])],
    }
    text = f"{before[0]:.4f} to {after[0]:.4f} m and {before[1]:.3f} to {after[1]:.3f} deg"
    if accepted != accepted_after:
        raise ConfigError(f"with --int8 other frames are accepted than without ({text}); leave it out")
    if (after > before * (1 + MOST_WORSE)).any():
        raise ConfigError(
            f"with --int8 the median error of {len(frames.images)} {frames.split} frames grows from {text}, more than "
            f"{MOST_WORSE:.0%}; leave it out"
        )
    return facts


def measure_errors(folder: Path, frames: CheckFrames) -> tuple[np.ndarray, list[str]]:
    """Median errors in the scene's unit and degrees (2,), and each frame's status.

    Of a model of clips the truth is moved to the first frame, as its answers are.
    """
    poses = locate_images(Localizer(ExportedSystem(folder)), frames.images)
    assert frames.position_m is not None
    assert frames.quat_wxyz is not None
    position, quat = frames.position_m, frames.quat_wxyz / np.linalg.norm(frames.quat_wxyz, axis=1, keepdims=True)
    found, turned = np.array([pose.position_m for pose in poses]), np.array([pose.quat_wxyz for pose in poses])
    away = np.linalg.norm(found - position, axis=1)
    angle = 2 * np.degrees(np.arccos(np.clip(np.abs((turned * quat).sum(axis=1)), 0, 1)))
    return np.array([np.median(away), np.median(angle)]), [pose.status for pose in poses]
