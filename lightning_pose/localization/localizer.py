"""Localizer: a trained system in the hand of a user; images in, poses out."""

from __future__ import annotations

import time
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Protocol, overload

import numpy as np

from lightning_pose.errors import ConfigError
from lightning_pose.geometry.absolute_pose import CameraPose
from lightning_pose.geometry.camera import Camera
from lightning_pose.localization.inputs import Color, ImageInput, LoadedImage, list_images, load_image
from lightning_pose.localization.load_source import load_system
from lightning_pose.localization.located_pose import LocatedPose

__all__ = ["Localizer", "LocatingSystem", "Prior"]

Prior = LocatedPose | tuple[np.ndarray, np.ndarray]
"""Where a camera is thought to be: an earlier answer, or position (3,) in the scene's unit and quaternion (4,) wxyz."""


class LocatingSystem(Protocol):
    """What a `Localizer` asks: a checkpoint's `TrainedSystem`, or the runner of an exported folder."""

    @property
    def name(self) -> str: ...
    @property
    def color(self) -> Color: ...
    @property
    def view(self) -> Camera | None: ...
    @property
    def clips(self) -> object | None: ...
    def locate(self, image: LoadedImage, camera: Camera | None, prior: CameraPose | None) -> LocatedPose: ...
    def locate_clip(self, images: Sequence[LoadedImage]) -> list[LocatedPose]: ...


class Localizer:
    """Locates images; nothing that it is asked changes it, and threads may share it.

    Args:
        system: what answers.

    >>> localizer = Localizer.load(checkpoint)
    >>> pose = localizer.localize(image)
    >>> pose.status, pose.position_m.shape, list(pose.milliseconds)
    ('accepted', (3,), ['read', 'features', 'locate', 'total'])
    >>> [pose.image == str(image) for pose in localizer.localize([image, image])]
    [True, True]
    """

    def __init__(self, system: LocatingSystem) -> None:
        self.system = system

    @classmethod
    def load(cls, source: str | Path, allow: str | Iterable[str] = (), tracking_uri: str | None = None) -> Localizer:
        """Load a localizer.

        Args:
            source: a checkpoint file that `fit` wrote.
            allow: class paths, or packages, of your own architectures, extractors and backbones that it may name.
            tracking_uri: MLflow's store, for runs and registered models; by default `MLFLOW_TRACKING_URI`, or else
                `sqlite:///mlruns/mlflow.db`.

        Raises:
            CheckpointError: it cannot be read, holds no data settings, or names a class that is not allowed.
            ConfigError: it is neither of these.
        """
        return cls(load_system(source, [allow] if isinstance(allow, str) else list(allow), tracking_uri))

    @overload
    def localize(
        self, image: ImageInput, camera: str | Camera | None = None, prior: Prior | None = None
    ) -> LocatedPose: ...
    @overload
    def localize(
        self, image: Sequence[ImageInput], camera: str | Camera | None = None, prior: Prior | None = None
    ) -> list[LocatedPose]: ...
    def localize(
        self,
        image: ImageInput | Sequence[ImageInput],
        camera: str | Camera | None = None,
        prior: Prior | None = None,
    ) -> LocatedPose | list[LocatedPose]:
        """Locate an image, or each of a list.

        Args:
            image: a file, a uint8 array (H, W) gray or (H, W, 3) RGB, a PIL image, or a list of these. For a model of
                clips a list is one video, in order, and the world is its first camera.
            camera: of all images, scaled to each, for systems with a map; in COLMAP's notation, as `data.camera` has
                it. That of the training images if not given.
            prior: where the camera is thought to be; for systems with a map.

        Returns:
            a pose, or a list of poses for a list.

        Raises:
            ConfigError: images are neither files nor such arrays; or the camera is not understood, not used, or for
                images of another shape.
            ImageError: an image cannot be read.
        """
        known = Camera.parse(camera) if isinstance(camera, str) else camera
        where = None if prior is None else _parse_prior(prior)
        if self.system.view is None:
            for name, value in (("camera", camera), ("prior", prior)):
                if value is not None:
                    raise ConfigError(f"{self.system.name} does not use a {name}; leave {name} out")
        images = list_images(image)
        if self.system.clips is not None:
            return self._localize_clip([image] if images is None else images, alone=images is None)
        if images is None:
            return self._localize_one(image, 0, known, where)
        return [self._localize_one(each, i, known, where) for i, each in enumerate(images)]

    def _localize_one(self, image: object, number: int, camera: Camera | None, prior: CameraPose | None) -> LocatedPose:
        started = time.perf_counter()
        loaded = load_image(image, self.system.color, number)
        read = time.perf_counter()
        pose = self.system.locate(loaded, camera, prior)
        return _add_times(pose, 1e3 * (read - started), 1e3 * (time.perf_counter() - started))

    def _localize_clip(self, images: Sequence[object], alone: bool) -> LocatedPose | list[LocatedPose]:
        started = time.perf_counter()
        loaded = [load_image(image, self.system.color, i) for i, image in enumerate(images)]
        read = time.perf_counter()
        poses = self.system.locate_clip(loaded)
        share = 1e3 / max(1, len(poses))
        ended = time.perf_counter()
        poses = [_add_times(pose, share * (read - started), share * (ended - started)) for pose in poses]
        return poses[0] if alone else poses


def _add_times(pose: LocatedPose, read: float, total: float) -> LocatedPose:
    """The pose with the milliseconds of reading, and of all."""
    return replace(pose, milliseconds={"read": read, **pose.milliseconds, "total": total})


def _parse_prior(prior: Prior) -> CameraPose:
    """Rotation and position of a prior.

    Raises:
        ConfigError: it is no pose.
    """
    try:
        position, quat = (prior.position_m, prior.quat_wxyz) if isinstance(prior, LocatedPose) else prior
        position, quat = np.asarray(position, np.float64), np.asarray(quat, np.float64)
    except (TypeError, ValueError):
        position = quat = np.zeros(0)
    length = np.linalg.norm(quat)
    if position.shape != (3,) or quat.shape != (4,) or not (np.isfinite([*position, *quat]).all() and length > 0):
        raise ConfigError("prior is no pose; give an earlier answer, or (position (3,), quaternion (4,) wxyz)")
    turned = LocatedPose(position, quat / length).T_world_cam
    return CameraPose(turned[:3, :3], turned[:3, 3])
