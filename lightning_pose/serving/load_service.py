"""Makes the server's `Service` from a localizer: what it is, its map from above, and how it answers an upload."""

from __future__ import annotations

import json
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import numpy as np
from safetensors.numpy import load_file

from lightning_pose import __version__
from lightning_pose.errors import ConfigError
from lightning_pose.localization.load_source import EXPORTED_FILE, find_checkpoint
from lightning_pose.localization.localizer import Localizer
from lightning_pose.localization.prior_text import parse_prior
from lightning_pose.serving.map_view import view_from_above
from lightning_pose.serving.service import Json, Service
from lightning_pose.serving.uploads import Upload

__all__ = ["load_service"]

BLANK = 64
"""Width and height of the image that a localizer without a map is tried with."""


def load_service(source: str | Path, allow: Iterable[str] = ()) -> Service:
    """Load a localizer, try it with a blank image, so that the first request finds it ready, and describe it.

    Args:
        source: what `Localizer.load` takes.
        allow: class paths, or packages, of your own that a checkpoint may name.

    Raises:
        ConfigError: it locates videos, or `source` is nothing that can be loaded.
        CheckpointError: it cannot be read.
    """
    place = Path(source).expanduser()
    if not place.is_dir():
        place = find_checkpoint(source)
    localizer = Localizer.load(place, allow)
    if localizer.system.clips is not None:
        raise ConfigError(
            f"{source} is a {localizer.system.name}, which locates videos; serve answers single images: locate videos "
            "with `python -m lightning_pose localize`, or frame by frame with VideoTracker in Python"
        )
    view = localizer.system.view
    size = (BLANK, BLANK) if view is None else (view.height, view.width)
    localizer.localize(np.zeros((*size, 3), np.uint8))

    def locate(upload: Upload) -> Json:
        pose = localizer.localize(upload.image, upload.camera, parse_prior(upload.prior))
        return replace(pose, image=upload.name).to_dict()

    return Service(locate, _describe_model(localizer, place), _draw_map(localizer, place))


def _describe_model(localizer: Localizer, place: Path) -> Json:
    """What `/model` says; names of folders, but not where they are."""
    system = localizer.system
    view = system.view
    facts = {"architecture": system.name, "camera": None if view is None else str(view), "reads": system.color}
    more = _read_exported(place) if place.is_dir() else _read_checkpoint(place)
    return {**facts, **more, "version": __version__}


def _read_exported(folder: Path) -> Json:
    """What an exported folder says of its training."""
    facts = json.loads((folder / EXPORTED_FILE).read_text("utf-8"))
    return {name: facts.get(name) for name in ("scene", "ground_truth")}


def _read_checkpoint(file: Path) -> Json:
    """Scene, ground truth and features that a checkpoint names."""
    from lightning_pose.checkpoint import read_checkpoint  # torch, which exported folders do without

    data = read_checkpoint(file)["lightning_pose"]["data"]["init_args"]
    scenes = data.get("train_scenes") or [data.get("root")]
    return {
        "scene": ", ".join(Path(str(scene)).name for scene in scenes if scene) or "synthetic room",
        "ground_truth": data.get("ground_truth"),
        "features": data["extractor"]["class_path"].rpartition(".")[2],
    }


def _draw_map(localizer: Localizer, place: Path) -> Json | None:
    """The map from above; None without a map."""
    points = localizer.system.read_map_points()
    if points is None or not len(points):
        return None
    rotation, position = _read_exported_cameras(place) if place.is_dir() else _read_cameras(localizer)
    return view_from_above(points, rotation, position)


def _read_cameras(localizer: Localizer) -> tuple[np.ndarray, np.ndarray]:
    """(F, 3, 3) and (F, 3) of a checkpoint's training cameras in the world."""
    import torch

    from lightning_pose.localization.trained_system import TrainedSystem

    system = localizer.system
    assert isinstance(system, TrainedSystem)
    network = system.model.map_network
    assert network is not None
    point_map = network.point_map
    return point_map.rotation, system.model.world_frame.to_world(torch.from_numpy(point_map.position)).numpy()


def _read_exported_cameras(folder: Path) -> tuple[np.ndarray, np.ndarray]:
    """The same of an exported folder."""
    facts = json.loads((folder / EXPORTED_FILE).read_text("utf-8"))
    arrays, world = load_file(folder / facts["map"]["file"]), facts["world"]
    return arrays["rotation"], np.array(world["origin"]) + world["scale"] * arrays["position"]
