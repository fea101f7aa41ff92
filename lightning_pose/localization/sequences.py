"""Trajectories of whole sequences from a model of clips: windows that share a frame, chained from the first frame."""

from __future__ import annotations

from collections import deque
from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

from lightning_pose.geometry.relative import Chain, RelativeFrame

if TYPE_CHECKING:
    from lightning_pose.data import ClipDataModule
    from lightning_pose.models.base import PoseModule

__all__ = ["Chained", "ClipFollower", "chain_test_split", "cut_windows", "locate_sequence"]


def cut_windows(frames: int, length: int) -> list[range]:
    """Clips of up to `length` frames that cover a sequence of `frames`, each beginning where the last one ended."""
    return [range(start, min(start + length, frames)) for start in range(0, max(1, frames - 1), length - 1)]


def locate_sequence(
    model: PoseModule,
    features: Tensor,
    clip_length: int,
    relative_frame: RelativeFrame = "camera",
    first_position_m: Tensor | None = None,
    first_quat_wxyz: Tensor | None = None,
) -> tuple[Tensor, Tensor]:
    """Compute the trajectory of a sequence of any length.

    Args:
        model: of clips, in evaluation mode.
        features: (M, *input_shape) of the sequence's frames, in order.
        clip_length: frames of a clip, 2 or more, as in training.
        relative_frame: axes of its positions, as in training.
        first_position_m: (3,) where the first frame is; the origin if not given.
        first_quat_wxyz: (4,) likewise; the identity if not given.

    Returns:
        position_m (M, 3) and quat_wxyz (M, 4), float64.
    """
    chain = Chain(relative_frame, first_position_m, first_quat_wxyz)
    for window in cut_windows(len(features), clip_length):
        with torch.inference_mode():
            pose = model(features[window.start : window.stop].unsqueeze(0).to(model.device))
        chain.add(list(window), pose.position_m[0], pose.quat_wxyz[0])
    _, position_m, quat_wxyz = chain.trajectory()
    return position_m, quat_wxyz


class ClipFollower:
    """Places the frames of a live video as they come: each by the clip of the last frames, which it ends.

    Args:
        model: of clips, in evaluation mode.
        clip_length: frames of a clip, 2 or more, as in training.
        relative_frame: axes of its positions, as in training.
    """

    def __init__(self, model: PoseModule, clip_length: int, relative_frame: RelativeFrame = "camera") -> None:
        self._model = model
        self._features: deque[Tensor] = deque(maxlen=clip_length)
        self._chain = Chain(relative_frame)
        self._count = 0

    def add(self, features: Tensor) -> tuple[Tensor, Tensor]:
        """The position (3,) and quaternion (4,) of the next frame, float64, in the axes of the first.

        Args:
            features: (*input_shape) of the frame.
        """
        self._features.append(features)
        self._count += 1
        numbers = list(range(self._count - len(self._features), self._count))
        with torch.inference_mode():
            pose = self._model(torch.stack(list(self._features)).unsqueeze(0).to(self._model.device))
        self._chain.add(numbers, pose.position_m[0], pose.quat_wxyz[0])
        for old in [number for number in self._chain.poses if number < numbers[0]]:
            del self._chain.poses[old]  # no later clip begins there
        return self._chain.poses[numbers[-1]]


class Chained(NamedTuple):
    """A run of M test frames and their poses as a model locates them.

    Attributes:
        rows: (M,) rows of the test split's data.
        position_m: (M, 3) float64, from the true position of the first frame.
        quat_wxyz: (M, 4) float64, from its true orientation.
    """

    rows: Tensor
    position_m: Tensor
    quat_wxyz: Tensor


def chain_test_split(model: PoseModule, datamodule: ClipDataModule) -> list[Chained]:
    """Locate the test split's runs of two frames or more, each from the true pose of its first frame."""
    data, model = datamodule.dataset("test").data, model.eval()
    found = []
    for rows in (torch.from_numpy(run[:: datamodule.stride]) for run in datamodule.dataset("test").runs):
        if len(rows) > 1:
            first = data.position_m[rows[0]], data.quat_wxyz[rows[0]]
            clips = datamodule.clip_length, datamodule.relative_frame
            found.append(Chained(rows, *locate_sequence(model, data.features[rows], *clips, *first)))
    return found
