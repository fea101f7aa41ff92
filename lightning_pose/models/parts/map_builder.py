"""MapBuilder: from the keypoints of a data module's frames to a point map in a `MapNetwork`."""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from lightning_pose.data.datamodule import SceneDataModule
from lightning_pose.errors import ConfigError, DataError
from lightning_pose.features.base import FeatureExtractor, LocalExtractor
from lightning_pose.geometry.absolute_pose import CameraPose
from lightning_pose.geometry.camera import Camera
from lightning_pose.mapping.build_map import (
    MappedFrames,
    add_frames,
    adjust_mapped,
    map_frames,
    roll_mapped,
    summarize_tracks,
)
from lightning_pose.mapping.calibration import (
    UNKNOWN,
    Measured,
    calibrate_map,
    choose_map,
    locate_frames,
    measure_answers,
    measure_left_out,
)
from lightning_pose.mapping.conventions import fit_focal_length
from lightning_pose.mapping.frame_matches import match_nearby_frames
from lightning_pose.mapping.frames import MapFrames
from lightning_pose.mapping.map_localizer import MapAnswer, MapLocalizer
from lightning_pose.models.parts.frame_cameras import find_frequent_camera, list_cameras
from lightning_pose.models.parts.map_network import MapNetwork, keypoints_to_frames
from lightning_pose.models.parts.world_frame import WorldFrame

__all__ = ["BundleAdjust", "MapBuilder", "check_bundle_adjust", "check_keypoints"]

BundleAdjust = bool | Literal["auto"]

FEWEST_VAL = 10
"""With fewer validation frames, training frames that are left out in turn say which map is best."""


def check_bundle_adjust(value: object) -> None:
    """Raise ConfigError unless it is true, false or auto."""
    if value not in (True, False, "auto"):
        raise ConfigError(f"bundle_adjust is {value!r}; give true, false or auto")


def check_keypoints(extractor: FeatureExtractor) -> None:
    """Raise ConfigError for features that are no keypoints, or come without their places in the image."""
    if not isinstance(extractor, LocalExtractor) or not extractor.with_geometry:
        raise ConfigError(
            f"LandmarkMap needs keypoints with their places, and {extractor.name} features have none; "
            "choose lightning_pose.features.SURF (or SIFT, ORB, AKAZE, FREAK, BRIEF), and set "
            "data.extractor.with_geometry: true"
        )


class MapBuilder:
    """Builds maps of the frames of one data module.

    Args:
        network: takes the maps.
        datamodule: its features are keypoints with their places.
        world_frame: of the map's positions.
        bundle_adjust: as for `LandmarkMap`; what `auto` finds holds for further maps.
        say: takes lines for the user.
    """

    def __init__(
        self,
        network: MapNetwork,
        datamodule: SceneDataModule,
        world_frame: WorldFrame,
        bundle_adjust: BundleAdjust,
        say: Callable[[str], None],
    ) -> None:
        self.network = network
        self.datamodule = datamodule
        self.world_frame = world_frame
        self.bundle_adjust = bundle_adjust
        self.say = say
        self._adjusts = bundle_adjust is True
        self._camera: Camera | None = None
        self._adjusted: MappedFrames | None = None
        self._val_answers: list[MapAnswer] | None = None
        self._val_measured: Measured | None = None

    def build(self, splits: tuple[str, ...], calibrate: bool) -> None:
        """Build the map of the frames of these splits; unless it is only to be validated, find its radii too.

        Raises:
            DataError: the frames give no point.
        """
        camera = self._find_camera()
        frames = self._read_frames(splits, camera)
        if splits == ("train",):
            mapped = self._choose_map(frames, camera, rounds=2 if calibrate else 1)
        elif self._adjusted is not None:
            mapped = self._add_validation_frames(self._adjusted, frames, camera)
        else:
            mapped = map_frames(frames, self._adjusts)
        if not len(mapped.tracks.points):
            raise DataError(
                f"no point of {self.datamodule.scene.root} could be triangulated from {len(frames)} frames; "
                "`python -m lightning_pose check` says whether the poses fit the images"
            )
        point_map = summarize_tracks(mapped)
        calibration = calibrate_map(mapped, self._val_measured) if calibrate else UNKNOWN
        self.network.set_map(point_map, camera, calibration)
        if calibrate:
            error_m = calibration.position_error * self.world_frame.scale
            self.say(
                f"map of {len(frames)} frames: {len(point_map)} points, {point_map.n_bytes / 1e6:.1f} MB, "
                f"bundle adjustment {_describe_adjustment(mapped)}; frames that were left out are located "
                f"to {error_m:.3g} {self.datamodule.scene.unit} and {calibration.orientation_error_deg:.2f} degrees "
                "(median)"
            )

    def _choose_map(self, frames: MapFrames, camera: Camera, rounds: int) -> MappedFrames:
        """The map of training frames, as given, adjusted, or with a rolling shutter: which locates frames best.

        Adding validation frames is another round of adjustment.
        """
        plain = map_frames(frames, adjust=False)
        if self.bundle_adjust is False or not len(plain.tracks.points):
            return plain
        adjusted = adjust_mapped(plain, rounds)
        rolled = roll_mapped(adjusted)
        candidates = [adjusted, rolled, *([plain] if self.bundle_adjust == "auto" else [])]
        if len(self.datamodule.scene.splits["val"]) >= FEWEST_VAL:
            val = self._read_frames(("val",), camera)
            best, self._val_answers = choose_map([summarize_tracks(each) for each in candidates], val)
            self._val_measured = measure_answers(self._val_answers, val)
        else:
            best = int(np.argmin([measure_left_out(each).mean_log_error for each in candidates]))
        chosen = candidates[best]
        self._adjusts = chosen is not plain
        self._adjusted = chosen if self._adjusts else None
        return chosen

    def _add_validation_frames(self, mapped: MappedFrames, every: MapFrames, camera: Camera) -> MappedFrames:
        """The map of training frames with the validation frames added where it locates them."""
        numbers = [self.datamodule.dataset(split).data.frame.numpy() for split in ("train", "val")]
        rows = np.searchsorted(np.sort(np.concatenate(numbers)), np.sort(numbers[0]))
        val = self._read_frames(("val",), camera)
        localizer = MapLocalizer(summarize_tracks(mapped))
        answers = self._val_answers or locate_frames(localizer, val)
        poses = [
            answer.pose_in_map
            if answer.accepted
            else localizer.given_poses.carry_forward(CameraPose(rotation, position))
            for answer, rotation, position in zip(answers, val.rotation, val.position, strict=True)
        ]
        return add_frames(mapped, every, rows, poses)

    def _read_frames(self, splits: tuple[str, ...], camera: Camera) -> MapFrames:
        """Keypoints and given poses of the frames of these splits, in the order of the scene.

        `camera` is that of frames whose own is unknown.
        """
        data = [self.datamodule.dataset(split).data for split in splits]
        index = torch.cat([part.frame for part in data])
        order = index.argsort()
        frames = [self.datamodule.scene.frames[i] for i in index[order].tolist()]
        quats = np.array([frame.quat_wxyz for frame in frames])
        return keypoints_to_frames(
            torch.cat([part.features for part in data])[order],
            list_cameras(self.datamodule, index[order].tolist(), camera),
            Rotation.from_quat(quats, scalar_first=True).as_matrix(),
            self.world_frame.to_local(torch.from_numpy(np.array([frame.position_m for frame in frames]))).numpy(),
        )

    def _find_camera(self) -> Camera:
        """The most frequent camera of the training frames, or one with the focal length that fits their poses."""
        if self._camera is None:
            frames = self.datamodule.scene.splits["train"].tolist()
            camera, count = find_frequent_camera(self.datamodule, frames)
            if count > 1:
                self.say(f"{count} cameras; images that come without one are located as if by {camera}")
            self._camera = self._fit_camera() if camera is None else camera
        return self._camera

    def _fit_camera(self) -> Camera:
        """The camera with the focal length that fits the training poses best.

        Raises:
            ConfigError: too few matches, or no motion.
        """
        scene = self.datamodule.scene
        width, height = self.datamodule.find_image_size("train")
        guess = Camera(width, height, 1.0, 1.0, (width - 1) / 2, (height - 1) / 2)
        frames = self._read_frames(("train",), guess)
        sequences = [scene.frames[i].sequence for i in self.datamodule.dataset("train").data.frame.tolist()]
        matches = match_nearby_frames(
            sequences,
            lambda i: (frames.points[i, : frames.count[i]], frames.descriptors[i, : frames.count[i]]),
        )
        _, residual_px, focal_px = fit_focal_length(matches, frames.rotation, frames.position, max(width, height))
        if not np.isfinite(residual_px):
            raise ConfigError(
                f"the camera of {scene.root} is unknown, and its frames do not tell the focal length (too few matches, "
                "or no motion); give data.camera, such as PINHOLE,640,480,525,525,320,240"
            )
        self.say(
            f"the camera is unknown: a focal length of {focal_px:.0f} px fits the poses best (matches lie "
            f"{residual_px:.2f} px off their epipolar lines); data.camera sets another"
        )
        return Camera(width, height, focal_px, focal_px, (width - 1) / 2, (height - 1) / 2)


def _describe_adjustment(mapped: MappedFrames) -> str:
    if mapped.state is None:
        return "off"
    return "on, for a rolling shutter" if mapped.state.rolling else "on"
