"""A trained localizer: images in, poses out, from one checkpoint file."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch

from lightning_pose.checkpoint import build_object, check_specs, read_checkpoint
from lightning_pose.errors import CheckpointError
from lightning_pose.features.base import FeatureExtractor
from lightning_pose.geometry.relative import RelativeFrame
from lightning_pose.localization.inputs import read_images
from lightning_pose.localization.sequences import locate_sequence

if TYPE_CHECKING:
    from lightning_pose.models import PoseModule

__all__ = ["Localizer"]


class Localizer:
    """An extractor and a network, restored from a checkpoint.

    Args:
        extractor: makes the features.
        model: makes the poses.
        clips: for a model of clips, frames of a clip and axes of its relative positions, as in training.
    """

    def __init__(
        self, extractor: FeatureExtractor, model: PoseModule, clips: tuple[int, RelativeFrame] | None = None
    ) -> None:
        self.extractor = extractor
        self.model = model.eval()
        self.clips = clips

    @classmethod
    def from_checkpoint(cls, path: str | Path, allow: str | Iterable[str] = ()) -> Localizer:
        """Restore a localizer from a checkpoint that `fit` wrote.

        Args:
            path: the file; it may come from anyone, because only classes of this package are imported.
            allow: class paths, or packages, of your own architectures, extractors and backbones that it may name.

        Raises:
            CheckpointError: the file cannot be read, holds no data settings, or names a class that is not allowed.
        """
        allow = [allow] if isinstance(allow, str) else list(allow)
        checkpoint = read_checkpoint(path)
        specs = check_specs(checkpoint["lightning_pose"], allow)
        if specs["data"] is None:
            raise CheckpointError(f"{path} does not say which features it reads; train with a data module")
        model: PoseModule = build_object(specs["model"] or {}, allow, "lightning_pose.models")
        try:
            model.load_state_dict(checkpoint["state_dict"])
        except (RuntimeError, AttributeError) as error:
            reason = " ".join(str(error).split())[:200]
            raise CheckpointError(f"the weights in {path} are not those of its settings ({reason})") from error
        data = specs["data"]["init_args"]
        clips = (data["clip_length"], data["relative_frame"]) if model.reads_clips else None
        return cls(build_object(data["extractor"], allow, "lightning_pose.features"), model, clips)

    def __call__(
        self, images: str | Path | np.ndarray | Sequence[str | Path | np.ndarray]
    ) -> tuple[np.ndarray, np.ndarray]:
        """Locate images.

        Args:
            images: M files, or uint8 arrays as `extractor.color` asks for: (H, W) gray or (H, W, 3) RGB. One image
                may stand alone, and is a list of one.

        Returns:
            position_m (M, 3) and quat_wxyz (M, 4), camera-to-world. For a model of clips the images are one video, in
            order, and the world is the first camera.

        Raises:
            ConfigError: images are neither files nor such arrays.
            ImageError: an image cannot be read.
        """
        extractor, arrays = self.extractor, read_images(images, self.extractor)
        if not arrays:
            return np.zeros((0, 3), np.float32), np.zeros((0, 4), np.float32)
        records = extractor.extract(arrays)
        features = torch.from_numpy(np.stack([extractor.features(record) for record in records]))
        if self.clips is not None:
            chained = locate_sequence(self.model, features, *self.clips)
            return chained[0].numpy(), chained[1].numpy()
        with torch.inference_mode():
            pose = self.model(features)
        return pose.position_m.numpy(), pose.quat_wxyz.numpy()
