"""MapExtender: the keypoints of a data module's frames, added to the map of a checkpoint."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np

from lightning_pose.checkpoint import build_object, check_specs, describe_object, read_checkpoint
from lightning_pose.data.datamodule import SceneDataModule
from lightning_pose.errors import ConfigError
from lightning_pose.mapping.calibration import (
    MIN_ANSWERS,
    UNKNOWN,
    Calibration,
    calibrate_answers,
    measure_frames,
)
from lightning_pose.mapping.extend_map import extend_map
from lightning_pose.mapping.map_localizer import MapLocalizer
from lightning_pose.mapping.point_map import PointMap
from lightning_pose.models.parts.map_builder import MapBuilder
from lightning_pose.models.parts.map_network import MapNetwork
from lightning_pose.models.parts.world_frame import WorldFrame

__all__ = ["KnownMap", "MapExtender", "read_known_map"]


class KnownMap(NamedTuple):
    """A map that is to have more frames, and where it lies in the world."""

    network: MapNetwork
    world_frame: WorldFrame


def read_known_map(path: str | Path, datamodule: SceneDataModule) -> KnownMap:
    """The map of a `LandmarkMap`'s checkpoint, for frames of a data module.

    Raises:
        CheckpointError: the file cannot be read.
        ConfigError: it is of another architecture, or its features are others than those of the data module.
    """
    checkpoint = read_checkpoint(path)
    written = checkpoint["lightning_pose"]
    model = check_specs({**written, "data": None} if isinstance(written, Mapping) else written)["model"] or {}
    data = written.get("data")
    arguments = data.get("init_args") if isinstance(data, Mapping) else None
    if model.get("class_path", "").rsplit(".", 1)[-1] != "LandmarkMap":
        raise ConfigError(
            f"model.extends is {path}, a checkpoint of {model.get('class_path')}; give one of a LandmarkMap"
        )
    theirs = arguments.get("extractor") if isinstance(arguments, Mapping) else None
    ours = describe_object(datamodule.extractor)
    if theirs != ours:
        raise ConfigError(
            f"the map of {path} has features of {_describe(theirs)}, and data.extractor is {_describe(ours)}; "
            "give data.extractor the same settings"
        )
    known = build_object(model, package="lightning_pose.models")
    known.load_state_dict(checkpoint["state_dict"])
    return KnownMap(known.network, known.world_frame)


class MapExtender(MapBuilder):
    """Adds the frames of one data module to a map; it is asked as a `MapBuilder` is.

    Args:
        known: the map, and where it lies.
        network: takes the map with more frames.
        datamodule: of the frames.
        say: takes lines for the user.
    """

    def __init__(
        self, known: KnownMap, network: MapNetwork, datamodule: SceneDataModule, say: Callable[[str], None]
    ) -> None:
        super().__init__(network, datamodule, known.world_frame, False, say)
        self.known = known.network
        self._trained: PointMap | None = None

    def build(self, splits: tuple[str, ...], calibrate: bool) -> None:
        """Add the frames of these splits; unless the map is only to be validated, find its radii too."""
        old, camera = self.known.point_map, self.known.view
        frames = self._read_frames(splits, camera)
        point_map = extend_map(old, frames)
        if splits == ("train",):
            self._trained = point_map
        self.network.set_map(point_map, camera, self._calibrate() if calibrate else UNKNOWN)
        if calibrate:
            self.say(
                f"map of {len(old.position)} frames and {len(frames)} more: {len(old)} points and "
                f"{len(point_map) - len(old)} more, {point_map.n_bytes / 1e6:.1f} MB"
            )

    def _calibrate(self) -> Calibration:
        """Radii by the validation frames, located without them; those of the old map where there are too few."""
        position_factor, orientation_factor = self.known.calibration.tolist()
        old = Calibration(position_factor, orientation_factor, np.nan, np.nan, np.nan)
        if self._trained is None or len(self.datamodule.scene.splits["val"]) < MIN_ANSWERS:
            return old
        found = calibrate_answers(
            measure_frames(MapLocalizer(self._trained), self._read_frames(("val",), self.known.view))
        )
        return found if np.isfinite(found.position_factor) else old


def _describe(spec: object) -> str:
    """An extractor's class and settings in a line."""
    if not isinstance(spec, Mapping) or not isinstance(spec.get("init_args"), Mapping):
        return "unknown settings"
    settings = ", ".join(f"{name}={value}" for name, value in spec["init_args"].items())
    return f"{str(spec.get('class_path')).rsplit('.', 1)[-1]}({settings})"
