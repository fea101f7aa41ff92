"""ExportedSystem: a folder that `export` wrote, as a `Localizer` asks it."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from lightning_pose.errors import CheckpointError
from lightning_pose.export.runner.checksums import check_facts, check_part
from lightning_pose.export.runner.clips import FrameFollower, chain_clips
from lightning_pose.export.runner.keypoints import (
    Keypoints,
    KeypointSettings,
    extract_keypoints,
    make_query,
    make_rows,
)
from lightning_pose.export.runner.network import Network, NetworkAnswer, fit_pixels
from lightning_pose.export.runner.rotation import Rotation
from lightning_pose.export.runner.tensors import read_tensors
from lightning_pose.geometry.absolute_pose import CameraPose
from lightning_pose.geometry.camera import Camera
from lightning_pose.localization.image_sizes import enlarge_image
from lightning_pose.localization.inputs import Color, LoadedImage
from lightning_pose.localization.located_pose import LocatedPose, describe_excess
from lightning_pose.mapping.map_localizer import MapAnswer, MapLocalizer
from lightning_pose.mapping.point_map import PointMap
from lightning_pose.scenes.cameras import scale_camera
from lightning_pose.scenes.images import to_gray

__all__ = ["FORMAT", "FORMAT_VERSION", "ExportedSystem", "read_facts"]

FORMAT = "lightning_pose localizer"
FORMAT_VERSION = 2
"""Raised when older runners cannot ask a newer folder; those below `OLDEST_VERSION` cannot be asked any more."""

OLDEST_VERSION = 1

SPHERE_90 = 1.4435
"""Radius that holds 90 % of a normal distribution in space, by the root of the sum of its three equal variances."""


def read_facts(folder: Path) -> dict[str, Any]:
    """What `localizer.json` says.

    Raises:
        CheckpointError: there is none, it is damaged, or it is of a version that cannot be asked.
    """
    path = folder / "localizer.json"
    try:
        facts = json.loads(path.read_text(encoding="utf-8"))
        version = facts["format_version"] if facts["format"] == FORMAT else None
    except FileNotFoundError:
        raise CheckpointError(f"{folder} has no localizer.json; give a folder that `export` wrote") from None
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise CheckpointError(f"{path} cannot be read as a localizer ({error}); export the model again") from error
    if not isinstance(version, int):
        raise CheckpointError(f"{path} is no localizer that `export` wrote; give another folder")
    if version > FORMAT_VERSION:
        raise CheckpointError(
            f"{folder} has format {version}, and this version reads up to {FORMAT_VERSION}; use the localizer.py in "
            "the folder, or install a newer version"
        )
    if version < OLDEST_VERSION:
        raise CheckpointError(f"{folder} has format {version}, which is not read any more; export the model again")
    check_facts(facts, path)
    return facts


class ExportedSystem:
    """A network, a map, or both, from one folder; asking them changes neither, so that threads may share them.

    Args:
        folder: that `export` wrote; no code in it is run.

    Raises:
        CheckpointError: as `read_facts`, or a file of it is missing or damaged.
        ConfigError: onnxruntime is not installed, and the folder has a network.
    """

    def __init__(self, folder: Path) -> None:
        facts = read_facts(folder)
        try:
            self.name: str = facts["system"]
            self.color: Color = facts["color"]
            self.clips: Mapping[str, Any] | None = facts["clips"]
            self.features: Mapping[str, Any] = facts["features"]
            self.origin, self.scale = np.array(facts["world"]["origin"]), float(facts["world"]["scale"])
            self.keypoints = read_keypoint_settings(self.features) if "keypoints" in self.features else None
            self.network = Network(check_part(folder, facts, facts["network"])) if facts["network"] else None
            self.map = (
                ExportedMap(check_part(folder, facts, facts["map"]["file"]), facts["map"], self.scale)
                if facts["map"]
                else None
            )
        except (KeyError, TypeError, ValueError) as error:
            raise CheckpointError(f"{folder}/localizer.json lacks {error}; export the model again") from error

    @property
    def view(self) -> Camera | None:
        """The camera of the map's images; None without a map."""
        return None if self.map is None else self.map.view

    def locate(self, image: LoadedImage, camera: Camera | None = None, prior: CameraPose | None = None) -> LocatedPose:
        """Locate one image, as it is.

        Args:
            image: of the `color` that is read.
            camera: of the image, for any size of its shape; None without a map.
            prior: where the camera is thought to be.

        Raises:
            ConfigError: the camera is for images of another shape.
        """
        started = time.perf_counter()
        found, for_map = None, image.array
        if self.map is not None:
            for_map = enlarge_image(image.array, self.map.view, camera or self.map.view)
            found = extract_keypoints(to_gray(for_map), self.map.settings)
        features = None
        if self.network is not None:
            shared = found if for_map is image.array and self.map is not None else None
            features = self.prepare_features(image.array, shared)
        extracted = time.perf_counter()
        alone = self.network.locate(features) if self.network is not None and features is not None else None
        answer, fields = None, {}
        if self.map is not None and found is not None:
            if prior is not None:
                prior = CameraPose(prior.rotation, (prior.position - self.origin) / self.scale)
            answer = self.map.locate(found, camera, prior)
            fields["inliers_px"] = self.map.find_inliers(answer, found, camera, image.size)
        fields |= self.combine(alone, answer)
        ended = time.perf_counter()
        fields["milliseconds"] = {"features": 1e3 * (extracted - started), "locate": 1e3 * (ended - extracted)}
        return LocatedPose(**fields, image=image.name)

    def read_map_points(self) -> np.ndarray | None:
        """(P, 3) points of the map in the world, in the scene's unit; None without a map."""
        return None if self.map is None else self.map.localizer.map.points * self.scale + self.origin

    def prepare_features(self, array: np.ndarray, shared: Keypoints | None) -> np.ndarray:
        """What the network takes of an image; `shared` are keypoints of the same image for the map."""
        if self.keypoints is not None:
            reuse = shared is not None and self.map is not None and self.map.settings.extracts_as(self.keypoints)
            found = shared if reuse else extract_keypoints(to_gray(array), self.keypoints)
            assert found is not None
            return make_rows(found, self.keypoints)[None]
        if "pixels" in self.features:
            height, width = self.features["pixels"]
            return fit_pixels(array, height, width)[None]
        return np.ascontiguousarray(array)

    def combine(self, alone: NetworkAnswer | None, answer: MapAnswer | None) -> dict[str, Any]:
        """The fields of a `LocatedPose`: the map's pose where it accepts, else the network's, or the map's guess."""
        fields: dict[str, Any] = {}
        if alone is not None:
            reason = describe_excess(alone.excess)
            fields = {
                "position_m": alone.position_m,
                "quat_wxyz": alone.quat_wxyz,
                "status": "refused" if reason else "accepted",
                "reason": reason,
                "radius_m": math.inf if reason else alone.radius_m,
                "radius_deg": math.inf if reason else alone.radius_deg,
            }
        if answer is None or self.map is None:
            return fields
        radius_m, radius_deg, covariance = self.map.measure_certainty(answer)
        if alone is None or answer.accepted:
            fields = {
                "position_m": answer.pose.position * self.scale + self.origin,
                "quat_wxyz": Rotation.from_matrix(answer.pose.rotation).as_quat(scalar_first=True),
                "radius_m": radius_m,
                "radius_deg": radius_deg,
                "source": answer.source,
                "covariance": covariance,
            }
        return fields | {
            "status": "accepted" if answer.accepted else "refused",
            "reason": answer.reason,
            "inliers": answer.inliers,
            "visible": answer.visible,
        }

    def locate_clip(self, images: Sequence[LoadedImage]) -> list[LocatedPose]:
        """Locate the frames of one video, in order; the world is the first camera."""
        if not images:
            return []
        assert self.network is not None
        assert self.clips is not None
        network, started = self.network, time.perf_counter()
        frames = np.concatenate([self.prepare_features(image.array, None) for image in images])
        extracted = time.perf_counter()
        position_m, quat_wxyz = chain_clips(
            len(frames),
            self.clips["length"],
            self.clips["relative_frame"] == "camera",
            self.clips["integrate"],
            lambda part: network.locate_clip(frames[None, part]),
        )
        share, ended = 1e3 / len(images), time.perf_counter()
        milliseconds = {"features": share * (extracted - started), "locate": share * (ended - extracted)}
        return [
            LocatedPose(position, quat, milliseconds=milliseconds, image=image.name)
            for image, position, quat in zip(images, position_m, quat_wxyz, strict=True)
        ]

    def start_clip(self) -> Callable[[LoadedImage], LocatedPose]:
        """A function that places the frames of one video as they come, for a model of clips."""
        assert self.network is not None
        assert self.clips is not None
        network, in_camera = self.network, self.clips["relative_frame"] == "camera"
        follower = FrameFollower(
            self.clips["length"],
            in_camera,
            self.clips["integrate"],
            lambda frames: network.locate_clip(np.concatenate(frames)[None]),
        )

        def locate_next(image: LoadedImage) -> LocatedPose:
            started = time.perf_counter()
            frame = self.prepare_features(image.array, None)
            extracted = time.perf_counter()
            position_m, quat_wxyz = follower.add(frame)
            ended = time.perf_counter()
            milliseconds = {"features": 1e3 * (extracted - started), "locate": 1e3 * (ended - extracted)}
            return LocatedPose(position_m, quat_wxyz, milliseconds=milliseconds, image=image.name)

        return locate_next


class ExportedMap:
    """The landmark map of a folder.

    Args:
        file: its arrays.
        facts: of the map, in `localizer.json`.
        scale: of the map's positions in the scene's unit.
    """

    def __init__(self, file: Path, facts: Mapping[str, Any], scale: float) -> None:
        self.settings = read_keypoint_settings(facts)
        camera = facts["camera"]
        self.view = Camera(**camera | {"distortion": tuple(camera["distortion"])})
        self.factors = [math.nan if factor is None else float(factor) for factor in facts["calibration"]]
        self.scale = scale
        self.localizer = MapLocalizer(PointMap(**read_tensors(file)))

    def locate(self, found: Keypoints, camera: Camera | None, prior: CameraPose | None) -> MapAnswer:
        """Where an image with these keypoints was taken; the prior is in the map's unit."""
        known = scale_camera(camera or self.view, *found.size, setting="camera")
        return self.localizer.locate(make_query(found, known), prior)

    def find_inliers(
        self, answer: MapAnswer, found: Keypoints, camera: Camera | None, size: tuple[int, int]
    ) -> np.ndarray | None:
        """(K, 2) float32 pixels of the keypoints of inliers, in the image of this size before it was enlarged."""
        if answer.shown is None:
            return None
        seen = self.localizer.map.camera_correction.distort(answer.shown.observed[answer.shown.inlier])
        pixels = scale_camera(camera or self.view, *found.size).project(seen)
        return ((pixels + 0.5) * (np.array(size) / found.size) - 0.5).astype(np.float32)

    def measure_certainty(self, answer: MapAnswer) -> tuple[float, float, np.ndarray | None]:
        """Radii that hold 90 % of errors, inf if refused; and the covariance as a `LocatedPose` has it."""
        radii = np.array([answer.position_sd * self.scale, answer.orientation_sd_deg]) * self.factors
        radius_m, radius_deg = radii.tolist() if answer.accepted else (math.inf, math.inf)
        if answer.covariance is None:
            return radius_m, radius_deg, None
        factors = [factor / SPHERE_90 if math.isfinite(factor) else 1.0 for factor in self.factors]
        change = np.zeros((6, 6))
        change[:3, 3:] = np.eye(3) * factors[0] * self.scale
        change[3:, :3] = answer.pose_in_map.rotation * factors[1]
        return radius_m, radius_deg, change @ answer.covariance @ change.T


def read_keypoint_settings(facts: Mapping[str, Any]) -> KeypointSettings:
    """The extractor in a part of `localizer.json`."""
    return KeypointSettings(**facts["keypoints"])


def load_system(source: str | Path, allow: Sequence[str] = (), tracking_uri: str | None = None) -> ExportedSystem:
    """The system of a folder; the other two arguments are for checkpoints, which cannot be read here.

    Raises:
        CheckpointError: as `ExportedSystem`, or this file itself is damaged.
    """
    folder, own = Path(source).expanduser(), Path(__file__)
    if own.resolve().parent == folder.resolve():  # else it may be another version's
        check_part(folder, read_facts(folder), own.name)
    return ExportedSystem(folder)
