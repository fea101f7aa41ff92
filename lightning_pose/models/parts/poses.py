"""Pose and Located, what architectures return, and checks that their input and output are finite numbers."""

from __future__ import annotations

import logging
from typing import NamedTuple

import torch
from torch import Tensor

from lightning_pose.data.batches import PoseBatch
from lightning_pose.errors import DataError

__all__ = ["Located", "Pose", "check_features", "check_poses"]

_log = logging.getLogger("lightning_pose")


class Pose(NamedTuple):
    """Camera-to-world poses: `position_m` (..., 3) in metres, `quat_wxyz` (..., 4) unit."""

    position_m: Tensor
    quat_wxyz: Tensor


class Located(NamedTuple):
    """Poses of a batch and which frames they are of.

    Attributes:
        frame: (B,) or (B, T) int64, index of each frame in `Scene.frames`.
        position_m: (B, ..., 3).
        quat_wxyz: (B, ..., 4), unit.
    """

    frame: Tensor
    position_m: Tensor
    quat_wxyz: Tensor


def check_features(data: PoseBatch, local: bool = False) -> None:
    """Warn of frames without features, and of those with fewer local features than the network reads.

    Args:
        data: the frames of a split.
        local: whether features are (M, N, D), with zero rows after the last feature of a frame.

    Raises:
        DataError: features of some frames are not finite numbers, or most frames have no features.
    """
    bad = [int(i) for i, row in zip(data.frame, data.features, strict=True) if not bool(row.isfinite().all())]
    if bad:
        raise DataError(
            f"{len(bad)} of {len(data.frame)} training frames have features that are not finite numbers, the first is "
            f"frame {bad[0]} of the scene; check the extractor, or leave these frames out"
        )

    empty = [int(i) for i, row in zip(data.frame, data.features, strict=True) if not bool(row.any())]
    if 2 * len(empty) > len(data.frame):
        raise DataError(
            f"{len(empty)} of {len(data.frame)} training frames have no features, the first is frame {empty[0]} of the "
            "scene; `python -m lightning_pose check` looks for blank and tiny images"
        )
    if empty:
        _log.warning(
            "%d of %d training frames have no features, the first is frame %d of the scene",
            len(empty),
            len(data.frame),
            empty[0],
        )
    if local:
        _warn_of_few_features(data)


def _warn_of_few_features(data: PoseBatch) -> None:
    """Log how many frames have fewer than N features, and how many such a frame has."""
    found = data.features.any(-1).sum(-1)
    wanted = data.features.shape[-2]
    few = found[(found > 0) & (found < wanted)]
    if len(few):
        _log.warning(
            "%d of %d training frames have fewer than %d features (median %d, least %d); their missing rows are zeros; "
            "lower data.extractor.n_features if these are many",
            len(few),
            len(found),
            wanted,
            int(few.median()),
            int(few.min()),
        )


def check_poses(located: Located, system: str, remedy: str) -> None:
    """Raise DataError if some poses are not finite numbers.

    Args:
        located: poses and their frames.
        system: what returned them.
        remedy: what the user can do, the end of the error's message.
    """
    count = len(located.frame)
    finite = torch.cat([part.reshape(count, -1) for part in located[1:]], dim=1).isfinite().all(1)
    if not finite.all():
        first = int(located.frame[~finite].flatten()[0])
        raise DataError(
            f"{system} returns poses that are not finite numbers, {count - int(finite.sum())} of {count}, the first "
            f"at frame {first} of the scene; {remedy}"
        )
