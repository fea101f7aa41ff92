"""Localizer: a trained system in the hand of a user; images in, poses out."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Protocol, overload

import numpy as np

from lightning_pose.errors import ConfigError
from lightning_pose.geometry.absolute_pose import CameraPose
from lightning_pose.geometry.camera import Camera
from lightning_pose.localization.exif import choose_camera, count_turns, turn_back, turn_camera, turn_prior
from lightning_pose.localization.inputs import Color, ImageInput, LoadedImage, is_video, list_images, load_image
from lightning_pose.localization.load_source import load_system
from lightning_pose.localization.located_pose import LocatedPose
from lightning_pose.localization.video import VideoReader, VideoTracker
from lightning_pose.scenes.cameras import has_shape

__all__ = ["Localizer", "LocatingSystem", "Prior"]

BLANK_SPREAD = 2.0
"""Standard deviation of pixels, of 255, below which a network refuses an image; maps count features."""

Prior = LocatedPose | tuple[np.ndarray, np.ndarray]
"""Where a camera is thought to be: an earlier answer, or position (3,) in the scene's unit and quaternion (4,) wxyz."""


class LocatingSystem(Protocol):
    """What a `Localizer` asks: a checkpoint's `TrainedSystem`, or the runner of an exported folder.

    Attributes:
        name: the architecture's.
        color: what `locate` reads: (H, W) `gray`, or (H, W, 3) `rgb`.
        view: the camera of the map's images; None without a map.
        clips: None, except for a model of clips.
    """

    @property
    def name(self) -> str: ...
    @property
    def color(self) -> Color: ...
    @property
    def view(self) -> Camera | None: ...
    @property
    def clips(self) -> object | None: ...

    def locate(self, image: LoadedImage, camera: Camera | None, prior: CameraPose | None) -> LocatedPose:
        """The pose of an image as it is; `camera` is for its shape, and None without a map."""
        ...

    def locate_clip(self, images: Sequence[LoadedImage]) -> list[LocatedPose]:
        """The poses of a video's frames, for a model of clips."""
        ...

    def read_map_points(self) -> np.ndarray | None:
        """(P, 3) points of the map in the world, in the scene's unit; None without a map."""
        ...

    def start_clip(self) -> Callable[[LoadedImage], LocatedPose]:
        """A function that places the frames of one video as they come, for a model of clips."""
        ...


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
            source: a checkpoint file that `fit` wrote, an MLflow run id, a model's address (`models:/NAME@ALIAS`,
                `runs:/RUN_ID/model`), or a folder that `export` wrote. It may come from anyone: only classes of this
                package are imported.
            allow: class paths, or packages, of your own architectures, extractors and backbones that it may name.
            tracking_uri: MLflow's store, for runs and models; by default `MLFLOW_TRACKING_URI`, or else
                `sqlite:///mlruns/mlflow.db`.

        Raises:
            CheckpointError: it cannot be read, holds no data settings, or names a class that is not allowed.
            ConfigError: it is none of these, or MLflow does not have it.
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
    ) -> LocatedPose | list[LocatedPose] | Iterator[LocatedPose]:
        """Locate an image, or each of a list.

        An image that EXIF says to turn is located as stored, and, if the map refuses it so, turned upright; a network
        without a map gets whichever is nearer to its training images. Without a `camera`, EXIF's focal length makes
        one where the image has another shape than the map's images, or a focal length that differs by over 10 %. The
        pose is always that of the pixels as stored; its `notes` say what was done.

        Args:
            image: a file, a uint8 array (H, W) gray or (H, W, 3) RGB, a PIL image, or a list of these. For a model of
                clips a list is one video, in order, and the world is its first camera. A video file gives an iterator,
                as `localize_video` does, which type checkers should be shown.
            camera: of all images, scaled to each, for systems with a map; in COLMAP's notation, as `data.camera` has
                it. That of the training images if not given.
            prior: where the camera is thought to be, for systems with a map. A pose that is not within half the median
                depth of the map's points and 30 degrees of it is refused. Where the map finds none, the points that
                the image should show there are matched.

        Returns:
            a pose, or a list of poses for a list.

        Raises:
            ConfigError: images are neither files nor such arrays; or the camera is not understood, not used, or for
                images of another shape.
            ImageError: an image cannot be read.
        """
        if isinstance(image, str | Path) and is_video(image) and Path(image).expanduser().is_file():
            if prior is not None:
                raise ConfigError("a video's frames have the pose before them as prior; leave prior out")
            return self.localize_video(image, camera)
        known, where = self.check_camera(camera), self._check_prior(prior)
        images = list_images(image)
        if self.system.clips is not None:
            return self._localize_clip([image] if images is None else images, alone=images is None)
        if images is None:
            return self._localize_one(image, 0, known, where)
        return [self._localize_one(each, i, known, where) for i, each in enumerate(images)]

    def localize_video(
        self, video: str | Path | int, camera: str | Camera | None = None, every: int = 1
    ) -> Iterator[LocatedPose]:
        """Locate the frames of a video one after the other, as `VideoTracker` does.

        Args:
            video: a file, or the index of a camera of this computer.
            camera: as for `localize`.
            every: 1 locates all frames, 2 every second one, and so on.

        Raises:
            ConfigError: as `localize`.
            ImageError: the video cannot be read.
        """
        reader, tracker = VideoReader(video, every), VideoTracker(self, camera)
        for frame in reader:
            yield replace(tracker.localize(frame.pixels, frame.time_s), image=frame.name)

    def check_camera(self, camera: str | Camera | None) -> Camera | None:
        """A camera that the user gives, parsed.

        Raises:
            ConfigError: it is not understood, or the system has no map that uses it.
        """
        if camera is not None and self.system.view is None:
            raise ConfigError(f"{self.system.name} does not use cameras; leave camera out")
        return Camera.parse(camera) if isinstance(camera, str) else camera

    def load_image(self, image: object, number: int = 0) -> LoadedImage:
        """Read an image as `locate_loaded` takes it; `number` is for messages.

        Raises:
            ConfigError: as `localize`.
            ImageError: the same.
        """
        return load_image(image, self.system.color, number)

    def locate_loaded(
        self, image: LoadedImage, camera: Camera | None = None, prior: CameraPose | None = None
    ) -> LocatedPose:
        """Locate an image that has been read; arguments as for `localize`, which adds the time of reading.

        Raises:
            ConfigError: the image has another shape than the camera's images.
        """
        turns = count_turns(image)
        if not turns:
            return self._locate_as_is(image, camera, prior)
        turned = image.turn(turns)
        try:
            stored = self._locate_as_is(image, camera, prior)
        except ConfigError:  # of another shape; it may have the right one when it is turned
            stored = None
        if stored is None or not stored.accepted or self.system.view is None:
            if camera is not None and (has_shape(camera, *image.size) or not has_shape(camera, *turned.size)):
                camera = turn_camera(camera, turns)
            prior = None if prior is None else turn_prior(prior, turns)
            upright = self._locate_as_is(turned, camera, prior)
            if stored is None or (upright.accepted, -upright.radius_m) > (stored.accepted, -stored.radius_m):
                return turn_back(upright, image, turns)
        return replace(stored, notes=(*stored.notes, f"EXIF orientation {image.orientation} is not applied"))

    def _locate_as_is(self, image: LoadedImage, camera: Camera | None, prior: CameraPose | None) -> LocatedPose:
        view = self.system.view
        if view is None:
            pose = self.system.locate(image, None, None)
            return _refuse_blank(pose) if float(image.array.std()) < BLANK_SPREAD else pose
        found, notes = choose_camera(image, view, camera)
        pose = self.system.locate(image, found, prior)
        return replace(pose, notes=(*pose.notes, *notes)) if notes else pose

    def _localize_one(self, image: object, number: int, camera: Camera | None, prior: CameraPose | None) -> LocatedPose:
        started = time.perf_counter()
        loaded = self.load_image(image, number)
        read = time.perf_counter()
        pose = self.locate_loaded(loaded, camera, prior)
        return _add_times(pose, 1e3 * (read - started), 1e3 * (time.perf_counter() - started))

    def _localize_clip(self, images: Sequence[object], alone: bool) -> LocatedPose | list[LocatedPose]:
        started = time.perf_counter()
        loaded = [self.load_image(image, i) for i, image in enumerate(images)]
        read = time.perf_counter()
        poses = self.system.locate_clip(loaded)
        share = 1e3 / max(1, len(poses))
        ended = time.perf_counter()
        poses = [_add_times(pose, share * (read - started), share * (ended - started)) for pose in poses]
        return poses[0] if alone else poses

    def _check_prior(self, prior: Prior | None) -> CameraPose | None:
        """Rotation and position of a prior.

        Raises:
            ConfigError: it is no pose, or the system has no map that uses it.
        """
        if prior is None:
            return None
        if self.system.view is None:
            raise ConfigError(f"{self.system.name} does not use a prior; leave prior out")
        return _parse_prior(prior)


def _refuse_blank(pose: LocatedPose) -> LocatedPose:
    """The pose that a network gives an image in which nothing is to be seen."""
    return replace(pose, status="refused", reason="the image is blank", radius_m=math.inf, radius_deg=math.inf)


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
