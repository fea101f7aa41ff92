"""Validation frames that a model has not learnt from, for metrics that are not those of its training."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from lightning_pose.data.datamodule import SceneDataModule
from lightning_pose.errors import DataError
from lightning_pose.models import PoseModule
from lightning_pose.models.parts.checkpoint_hooks import LEARNT_FRAMES, key_frame

__all__ = ["keep_unseen_frames"]


def keep_unseen_frames(checkpoint: Mapping[str, Any], model: PoseModule, datamodule: SceneDataModule) -> int:
    """Leave the frames that a checkpoint has learnt from out of its data's validation split.

    Args:
        checkpoint: as `read_checkpoint` returns it.
        model: of the checkpoint.
        datamodule: its validation split is changed.

    Returns:
        How many validation frames were left out.

    Raises:
        DataError: no frame is left.
    """
    scene = datamodule.scene
    own = scene.splits["val"]
    if LEARNT_FRAMES in checkpoint:
        learnt = set(checkpoint[LEARNT_FRAMES].tolist())
        kept = [i for i in own if key_frame(scene.frames[i]) not in learnt]
    else:  # an older version's, which does not say which frames
        kept = [] if "val" in model.training_splits else list(own)
    if len(own) and not kept:
        raise DataError(
            f"this {type(model).__name__} has learnt from all {len(own)} validation frames of {scene.root} "
            "(model.refit), so that none is left to validate on; run `test`, or train with --model.refit false"
        )
    datamodule.replace_split("val", np.array(kept, dtype=np.int64))
    return len(own) - len(kept)
