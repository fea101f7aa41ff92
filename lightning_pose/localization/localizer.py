"""A trained localizer: images in, poses out, from one checkpoint file."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch

from lightning_pose.checkpoint import build_object, check_specs, read_checkpoint
from lightning_pose.errors import CheckpointError, ConfigError
from lightning_pose.features.base import FeatureExtractor, Record
from lightning_pose.geometry.camera import Camera
from lightning_pose.geometry.relative import RelativeFrame
from lightning_pose.localization.inputs import enlarge_images, read_images
from lightning_pose.localization.sequences import locate_sequence
from lightning_pose.scenes.images import to_gray

if TYPE_CHECKING:
    from lightning_pose.models import PoseModule
    from lightning_pose.models.parts.answers import Answers

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
        self,
        images: str | Path | np.ndarray | Sequence[str | Path | np.ndarray],
        camera: str | Camera | None = None,
    ) -> tuple[np.ndarray, np.ndarray]:
        """Locate images.

        Args:
            images: M files, or uint8 arrays as `extractor.color` asks for: (H, W) gray or (H, W, 3) RGB. One image
                may stand alone, and is a list of one.
            camera: of all images, scaled to each, for systems with a map; in COLMAP's notation, as `data.camera` has
                it. That of the training images if not given.

        Returns:
            position_m (M, 3) and quat_wxyz (M, 4), camera-to-world. For a model of clips the images are one video, in
            order, and the world is the first camera.

        Raises:
            ConfigError: images are neither files nor such arrays; or the camera is not understood, not used, or for
                images of another shape.
            ImageError: an image cannot be read.
        """
        answers = self.locate(images, camera)
        return answers.position_m, answers.quat_wxyz

    def locate(
        self,
        images: str | Path | np.ndarray | Sequence[str | Path | np.ndarray],
        camera: str | Camera | None = None,
    ) -> Answers:
        """As a call, and say of each pose what it comes from, and how sure it is."""
        from lightning_pose.models.parts.answers import answer_by_network  # Lightning, which takes seconds to import
        from lightning_pose.models.parts.poses import Pose

        camera = Camera.parse(camera) if isinstance(camera, str) else camera
        extractor, arrays = self.extractor, read_images(images, self.extractor)
        if not arrays:
            return answer_by_network(Pose(torch.zeros(0, 3), torch.zeros(0, 4)))
        if self.clips is not None:
            if camera is not None:
                raise ConfigError(f"{type(self.model).__name__} does not use cameras; leave camera out")
            features = _stack_features(extractor, extractor.extract(arrays))
            return answer_by_network(Pose(*locate_sequence(self.model, features, *self.clips)[:2]))
        view, refinement = self.model.map_camera, self.model.refinement
        for_map = arrays if view is None else enlarge_images(arrays, view, camera)
        records = extractor.extract(for_map if refinement is None else arrays)
        keypoints = None
        if refinement is not None:
            shared = for_map is arrays and refinement.extractor.shares_records(extractor)
            of_map = records if shared else refinement.extractor.extract([to_gray(array) for array in for_map])
            keypoints = _stack_features(refinement.extractor, of_map)
        sizes = [array.shape[1::-1] for array in for_map]
        with torch.inference_mode():
            return self.model.locate_images(_stack_features(extractor, records), sizes, camera, keypoints)


def _stack_features(extractor: FeatureExtractor, records: Sequence[Record]) -> torch.Tensor:
    """(M, *feature_shape) of M records."""
    return torch.from_numpy(np.stack([extractor.features(record) for record in records]))
