"""TrainedSystem: an extractor and a network, restored from a checkpoint, as a `Localizer` asks them."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch

from lightning_pose.checkpoint import build_object, check_specs, read_checkpoint
from lightning_pose.errors import CheckpointError
from lightning_pose.features.base import FeatureExtractor, Record
from lightning_pose.geometry.absolute_pose import CameraPose
from lightning_pose.geometry.camera import Camera
from lightning_pose.geometry.relative import RelativeFrame
from lightning_pose.localization.image_sizes import enlarge_image
from lightning_pose.localization.inputs import Color, LoadedImage
from lightning_pose.localization.located_pose import LocatedPose, describe_excess
from lightning_pose.localization.sequences import ClipFollower, locate_sequence
from lightning_pose.mapping.map_localizer import ShownPoints
from lightning_pose.scenes.cameras import scale_camera
from lightning_pose.scenes.images import to_gray

if TYPE_CHECKING:
    from lightning_pose.models import PoseModule
    from lightning_pose.models.parts.answers import Answers

__all__ = ["TrainedSystem"]


class TrainedSystem:
    """An extractor and a network; asking them changes neither, so that threads may share them.

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
    def from_checkpoint(cls, path: str | Path, allow: str | Iterable[str] = ()) -> TrainedSystem:
        """Restore a system from a checkpoint that `fit` wrote.

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

    @property
    def name(self) -> str:
        """The architecture's."""
        return type(self.model).__name__

    @property
    def color(self) -> Color:
        """What the extractor reads."""
        return self.extractor.color

    @property
    def view(self) -> Camera | None:
        """The camera of the map's images; None without a map."""
        network = self.model.map_network
        return None if network is None else network.view

    def read_map_points(self) -> np.ndarray | None:
        """(P, 3) points of the map in the world, in the scene's unit; None without a map."""
        network = self.model.map_network
        return (
            None
            if network is None
            else self.model.world_frame.to_world(torch.from_numpy(network.point_map.points)).numpy()
        )

    def locate(self, image: LoadedImage, camera: Camera | None = None, prior: CameraPose | None = None) -> LocatedPose:
        """Locate one image, as it is.

        Args:
            image: of the `color` that is read.
            camera: of the image, for any size of its shape; None without a map.
            prior: where the camera is thought to be.

        Raises:
            ConfigError: the system does not use cameras or priors, or the camera is for images of another shape.
        """
        started = time.perf_counter()
        view, extractor, refinement = self.view, self.extractor, self.model.refinement
        array = for_map = image.array
        if view is not None:
            for_map = enlarge_image(array, view, camera or view)
        record = extractor.extract([for_map if refinement is None else array])[0]
        keypoints = None
        if refinement is not None:
            shared = for_map is array and refinement.extractor.shares_records(extractor)
            of_map = record if shared else refinement.extractor.extract([to_gray(for_map)])[0]
            keypoints = torch.from_numpy(refinement.extractor.features(of_map)[None])
        features = self._make_features(record)[None]
        extracted = time.perf_counter()
        size = for_map.shape[1], for_map.shape[0]
        with torch.inference_mode():
            answers = self.model.locate_images(features, [size], camera, keypoints, prior)
        ended = time.perf_counter()
        milliseconds = {"features": 1e3 * (extracted - started), "locate": 1e3 * (ended - extracted)}
        pose = _read_answer(answers, milliseconds, image.name)
        if view is None or answers.shown[0] is None:
            return pose
        scale = np.array(image.size) / size
        return replace(pose, inliers_px=self._find_inliers(answers.shown[0], camera or view, size, scale))

    def _make_features(self, record: Record) -> torch.Tensor:
        """What the model reads of an image.

        Raises:
            CheckpointError: the model reads features of another shape.
        """
        features, wanted = self.extractor.features(record), tuple(self.model.input_shape)
        if features.shape != wanted:
            raise CheckpointError(
                f"the checkpoint's {self.extractor.name} features have the shape {features.shape}, and its {self.name} "
                f"reads {wanted}; it is damaged, train it again"
            )
        return torch.from_numpy(features)

    def _find_inliers(self, shown: ShownPoints, camera: Camera, size: tuple[int, int], scale: np.ndarray) -> np.ndarray:
        """(K, 2) float32 pixels of the keypoints of inliers, in the image before it was enlarged by 1 / `scale`."""
        network = self.model.map_network
        assert network is not None, "it has answered"
        seen = network.point_map.camera_correction.distort(shown.observed[shown.inlier])
        pixels = scale_camera(camera, *size).project(seen)
        return ((pixels + 0.5) * scale - 0.5).astype(np.float32)

    def locate_clip(self, images: Sequence[LoadedImage]) -> list[LocatedPose]:
        """Locate the frames of one video, in order, with a model of clips; the world is the first camera.

        Returns:
            poses as a test chains them; each frame has its share of the milliseconds.
        """
        assert self.clips is not None, "a model of clips"
        if not images:
            return []
        started = time.perf_counter()
        records = self.extractor.extract([image.array for image in images])
        features = torch.stack([self._make_features(record) for record in records])
        extracted = time.perf_counter()
        position_m, quat_wxyz = locate_sequence(self.model, features, *self.clips)
        ended = time.perf_counter()
        share = 1e3 / len(images)
        milliseconds = {"features": share * (extracted - started), "locate": share * (ended - extracted)}
        return [
            LocatedPose(position, quat, milliseconds=milliseconds, image=image.name)
            for image, position, quat in zip(images, position_m.numpy(), quat_wxyz.numpy(), strict=True)
        ]

    def start_clip(self) -> Callable[[LoadedImage], LocatedPose]:
        """A function that places the frames of one video as they come, with a model of clips."""
        assert self.clips is not None, "a model of clips"
        follower = ClipFollower(self.model, *self.clips)

        def locate_next(image: LoadedImage) -> LocatedPose:
            started = time.perf_counter()
            record = self.extractor.extract([image.array])[0]
            features = self._make_features(record)
            extracted = time.perf_counter()
            position_m, quat_wxyz = follower.add(features)
            ended = time.perf_counter()
            milliseconds = {"features": 1e3 * (extracted - started), "locate": 1e3 * (ended - extracted)}
            return LocatedPose(position_m.numpy(), quat_wxyz.numpy(), milliseconds=milliseconds, image=image.name)

        return locate_next


def _read_answer(answers: Answers, milliseconds: dict[str, float], image: str | None) -> LocatedPose:
    """The only one of a model's answers."""
    inliers, visible = int(answers.inliers[0]), int(answers.visible[0])
    covariance = answers.covariance[0]
    reason = answers.reason[0] or describe_excess(float(answers.excess[0]))
    return LocatedPose(
        position_m=answers.position_m[0].astype(np.float64),
        quat_wxyz=answers.quat_wxyz[0].astype(np.float64),
        status="refused" if reason else "accepted",
        reason=reason,
        source=answers.source[0],
        radius_m=float(answers.radius_m[0]),
        radius_deg=float(answers.radius_deg[0]),
        covariance=None if math.isnan(covariance[0, 0]) else covariance,
        inliers=None if inliers < 0 else inliers,
        visible=None if visible < 0 else visible,
        milliseconds=milliseconds,
        image=image,
    )
