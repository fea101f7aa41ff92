"""The images on which an exported folder must agree with its checkpoint."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from lightning_pose.checkpoint import build_object
from lightning_pose.errors import ConfigError, PoseError
from lightning_pose.localization.trained_system import TrainedSystem

if TYPE_CHECKING:
    from lightning_pose.data import SceneDataModule

__all__ = ["CheckFrames", "find_run_frames", "list_image_files"]

FRAMES = 20
"""Images of a run that are compared, evenly spread over its test frames."""

CLIPS = 3
"""Clips, of one video, for a model of clips."""

SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp", ".ppm", ".pgm")


class CheckFrames:
    """Images with their poses, where these are known.

    Attributes:
        images: files.
        split: which frames of the run they are; empty for images of the user.
        position_m: (N, 3) of the truth; None for images of the user.
        quat_wxyz: (N, 4) likewise.
        metre: what counts as a metre, in a scene whose unit is arbitrary; None if it is one of length, or unknown.
    """

    def __init__(
        self,
        images: Sequence[Path],
        split: str = "",
        position_m: np.ndarray | None = None,
        quat_wxyz: np.ndarray | None = None,
        metre: float | None = None,
    ) -> None:
        self.images, self.split, self.position_m, self.quat_wxyz = list(images), split, position_m, quat_wxyz
        self.metre = metre


def list_image_files(paths: Sequence[Path]) -> CheckFrames:
    """Image files, and those in folders, sorted.

    Raises:
        ConfigError: there are none.
    """
    files: list[Path] = []
    for path in paths:
        inside = sorted(file for file in path.iterdir() if file.suffix.lower() in SUFFIXES) if path.is_dir() else [path]
        files += inside
    missing = [file for file in files if not file.is_file()]
    if missing or not files:
        raise ConfigError(f"--images names {missing[0] if missing else 'no image'}; give image files or their folders")
    return CheckFrames(files)


def find_run_frames(
    system: TrainedSystem, data: Mapping[str, Any], allow: Sequence[str], root: str | None, every: bool = False
) -> CheckFrames:
    """Test frames of a checkpoint's run; where it has none, validation or training frames.

    Args:
        system: of the checkpoint.
        data: spec of its data module.
        allow: classes of the user that it may name.
        root: the scene's folder, if it has moved.
        every: all frames of the split instead of `FRAMES`.

    Raises:
        ConfigError: they are not to be found; the message has the remedy.
    """
    settings = data["init_args"] | {"extractor": system.extractor} | ({"root": root} if root else {})
    try:
        datamodule: SceneDataModule = build_object({**data, "init_args": settings}, allow, "lightning_pose.data")
        scene = datamodule.scene
        split = next(name for name in ("test", "val", "train") if len(scene.splits[name]))
        numbers = [int(i) for i in scene.splits[split]]
        if system.clips is not None:
            first = scene.frames[numbers[0]].sequence
            length = CLIPS * (system.clips[0] - 1) + 1
            chosen = [i for i in numbers if scene.frames[i].sequence == first][:length]
        else:
            count = len(numbers) if every else min(FRAMES, len(numbers))
            chosen = [numbers[i] for i in np.linspace(0, len(numbers) - 1, count).round().astype(int)]
        frames = [scene.frames[i] for i in chosen]
        missing = [frame.image for frame in frames if not Path(frame.image).is_file()]
        if missing:
            raise ConfigError(f"{missing[0]} does not exist")
    except PoseError as error:
        raise ConfigError(
            f"the run's own frames, which the exported model is checked with, are not to be found ({error}); give "
            "--root with the scene's folder, or --images with a few images of the place"
        ) from error
    return CheckFrames(
        [Path(frame.image) for frame in frames],
        split,
        np.array([frame.position_m for frame in frames]),
        np.array([frame.quat_wxyz for frame in frames]),
        None if scene.unit == "m" else measure_spread(np.array([frame.position_m for frame in scene.frames])),
    )


def measure_spread(position: np.ndarray) -> float:
    """Root mean square distance of positions (N, 3) from their mean, which of a walk in a room is about a metre."""
    return float(np.sqrt(np.square(position - position.mean(axis=0)).sum(axis=1).mean()))
