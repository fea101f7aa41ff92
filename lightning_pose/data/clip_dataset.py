"""Clips: windows of T consecutive frames of one sequence, cut by index from frames that are in memory once."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from lightning_pose.data.batches import PoseBatch, PoseDataset
from lightning_pose.errors import ConfigError, DataError
from lightning_pose.geometry.relative import RelativeFrame, relative_poses
from lightning_pose.scenes.gaps import find_run_starts
from lightning_pose.scenes.scene import Scene

__all__ = ["Augmentation", "ClipDataset", "ClipShape", "find_runs", "mirror_poses"]

_log = logging.getLogger("lightning_pose")


@dataclass(frozen=True)
class ClipShape:
    """How clips are cut.

    Attributes:
        length: T, frames of a clip; 2 or more.
        stride: from one of its frames to the next.
        hop: from the first frame of a clip to that of the next; by default clips share one frame, so that they chain.

    Raises:
        ConfigError: a number is out of its range.
    """

    length: int
    stride: int = 1
    hop: int | None = None

    def __post_init__(self) -> None:
        if self.length < 2:
            raise ConfigError(f"clip_length is {self.length}; give 2 frames or more")
        for name, value in (("stride", self.stride), ("hop", self.hop)):
            if value is not None and value < 1:
                raise ConfigError(f"{name} is {value}; give 1 frame or more")

    @property
    def span(self) -> int:
        """Frames from a clip's first to its last, both counted."""
        return (self.length - 1) * self.stride + 1

    @property
    def step(self) -> int:
        """The hop in frames."""
        return self.span - 1 if self.hop is None else self.hop

    def starts(self, frames: int) -> list[int]:
        """First frames of the clips of a run of `frames`; the last clip ends where the run does."""
        last = frames - self.span
        return [*range(0, last, self.step), last] if last >= 0 else []


@dataclass(frozen=True)
class Augmentation:
    """Random changes to training clips, drawn for each clip.

    Attributes:
        wander: begin up to a hop later.
        max_stride: take every k-th frame, k from the clips' stride up to this where the run is long enough, so that
            the camera moves faster than in the recording.
        reverse: play half of the clips backwards.
        mirror: turns (..., features) into those of the mirrored images, for half of the clips.
    """

    wander: bool = False
    max_stride: int = 1
    reverse: bool = False
    mirror: Callable[[Tensor], Tensor] | None = None


def find_runs(scene: Scene, indices: np.ndarray) -> list[np.ndarray]:
    """Find the rows of `indices` that follow each other in one sequence, with no gap or other split's frame between.

    Args:
        scene: whose frames of a sequence are consecutive.
        indices: (F,) ascending frame indices.

    Returns:
        one array of rows a run.
    """
    if not len(indices):
        return []
    breaks = np.flatnonzero((np.diff(indices) > 1) | find_run_starts(scene)[indices[1:]]) + 1
    return np.split(np.arange(len(indices)), breaks)


def mirror_poses(position_m: Tensor, quat_wxyz: Tensor) -> tuple[Tensor, Tensor]:
    """Poses of the cameras that see the mirrored images, in the world mirrored at x = 0.

    A mirrored image is the image of a camera in a mirrored world: with S = diag(-1, 1, 1), x becomes S x and R becomes
    S R S.

    Args:
        position_m: (..., 3).
        quat_wxyz: (..., 4).
    """
    return position_m * position_m.new_tensor([-1.0, 1, 1]), quat_wxyz * quat_wxyz.new_tensor([1.0, 1, -1, -1])


class ClipDataset(PoseDataset):
    """Clips of one split. Indexing by a list gives the whole batch in one gather: frames are shared, not copied.

    A batch has features (B, T, ...), poses relative to each clip's first frame (B, T, 3) and (B, T, 4), and frames
    (B, T).

    Args:
        data: the split's frames one by one, with their poses in the world.
        runs: rows of `data` that follow each other, as from `find_runs`.
        shape: how clips are cut.
        relative_frame: as for `relative_poses`.
        augmentation: random changes to clips; none if not given.

    Raises:
        DataError: no run is as long as a clip.
    """

    def __init__(
        self,
        data: PoseBatch,
        runs: Sequence[np.ndarray],
        shape: ClipShape,
        relative_frame: RelativeFrame = "camera",
        augmentation: Augmentation | None = None,
    ) -> None:
        super().__init__(data)
        self.runs = list(runs)
        self.shape = shape
        self.relative_frame: RelativeFrame = relative_frame
        self.augmentation = augmentation or Augmentation()
        starts, ends = [], []
        for run in runs:
            for start in shape.starts(len(run)):
                starts.append(int(run[0]) + start)
                ends.append(int(run[-1]) + 1)
        if not starts:
            longest = max((len(run) for run in runs), default=0)
            raise DataError(
                f"a clip of {shape.length} frames with stride {shape.stride} spans {shape.span} frames, but the "
                f"longest run of consecutive frames has {longest}; give a shorter data.clip_length or data.stride"
            )
        short = sum(len(run) < shape.span for run in runs)
        if short:
            _log.warning(
                "%d of %d runs of frames are shorter than a clip (%d) and left out", short, len(runs), shape.span
            )
        self._starts, self._ends = torch.tensor(starts), torch.tensor(ends)

    def __len__(self) -> int:
        return len(self._starts)

    def __getitem__(self, index: int) -> PoseBatch:
        return PoseBatch(*(tensor[0] for tensor in self.__getitems__([index])))

    def __getitems__(self, indices: Sequence[int]) -> PoseBatch:
        rows = self._rows(self._starts[list(indices)], self._ends[list(indices)])
        features, position_m, quat_wxyz, frame = (tensor[rows] for tensor in self.data)
        if self.augmentation.mirror is not None:
            chosen = torch.rand(len(rows)) < 0.5
            features[chosen] = self.augmentation.mirror(features[chosen])
            position_m[chosen], quat_wxyz[chosen] = mirror_poses(position_m[chosen], quat_wxyz[chosen])
        return PoseBatch(features, *self._relate_poses(position_m, quat_wxyz), frame)

    def _rows(self, starts: Tensor, ends: Tensor) -> Tensor:
        """(B, T) rows of `data` of the clips that begin at `starts` in runs that end before `ends`."""
        stride = torch.full_like(starts, self.shape.stride)
        if self.augmentation.max_stride > self.shape.stride:
            most = ((ends - starts - 1) // (self.shape.length - 1)).clamp(max=self.augmentation.max_stride)
            stride += (torch.rand(len(starts)) * (most - stride + 1)).long()
        if self.augmentation.wander:
            room = (ends - starts - (self.shape.length - 1) * stride).clamp(max=self.shape.step)
            starts = starts + (torch.rand(len(starts)) * room).long()
        rows = starts[:, None] + torch.arange(self.shape.length) * stride[:, None]
        if self.augmentation.reverse:
            rows = torch.where(torch.rand(len(rows), 1) < 0.5, rows.flip(1), rows)
        return rows

    def targets(self) -> tuple[Tensor, Tensor]:
        """Relative poses (W, T, 3) and (W, T, 4) of all clips as they are cut, without augmentation."""
        rows = self.rows()
        return self._relate_poses(self.data.position_m[rows], self.data.quat_wxyz[rows])

    def _relate_poses(self, position_m: Tensor, quat_wxyz: Tensor) -> tuple[Tensor, Tensor]:
        """Poses (W, T, ...) relative to each clip's first frame, computed in float64, in the data's own precision."""
        moved, turned = relative_poses(position_m.double(), quat_wxyz.double(), self.relative_frame)
        return moved.to(position_m.dtype), turned.to(quat_wxyz.dtype)

    def rows(self) -> Tensor:
        """(W, T) rows of `data` of all clips, likewise."""
        return self._starts[:, None] + torch.arange(self.shape.length) * self.shape.stride
