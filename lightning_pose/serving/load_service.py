"""Makes the server's `Service` from a localizer: what it is, its map from above, and how it answers an upload."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import numpy as np

from lightning_pose import __version__
from lightning_pose.checkpoint import read_checkpoint
from lightning_pose.errors import ConfigError
from lightning_pose.localization.localizer import Localizer
from lightning_pose.localization.prior_text import parse_prior
from lightning_pose.localization.trained_system import TrainedSystem
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
    localizer = Localizer.load(source, allow)
    if localizer.system.clips is not None:
        raise ConfigError(f"{source} is a {localizer.system.name}, which locates videos; serve answers single images")
    view = localizer.system.view
    size = (BLANK, BLANK) if view is None else (view.height, view.width)
    localizer.localize(np.zeros((*size, 3), np.uint8))

    def locate(upload: Upload) -> Json:
        pose = localizer.localize(upload.image, upload.camera, parse_prior(upload.prior))
        return replace(pose, image=upload.name).to_dict()

    return Service(locate, _describe_model(localizer, source), _draw_map(localizer, source))


def _describe_model(localizer: Localizer, source: str | Path) -> Json:
    """What `/model` says; names of folders, but not where they are."""
    system = localizer.system
    view = system.view
    facts = {"architecture": system.name, "camera": None if view is None else str(view), "reads": system.color}
    told = _read_exported(source) if Path(source).is_dir() else _read_checkpoint(source)
    return {**facts, **told, "version": __version__}


def _read_exported(folder: str | Path) -> Json:
    """The ground truth that an exported folder names."""
    return {"ground_truth": json.loads((Path(folder) / EXPORTED_FILE).read_text("utf-8")).get("ground_truth")}


def _read_checkpoint(source: str | Path) -> Json:
    """Scene, ground truth and features that a checkpoint names."""
    data = read_checkpoint(find_checkpoint(source))["lightning_pose"]["data"]["init_args"]
    scenes = data.get("train_scenes") or [data.get("root")]
    return {
        "scene": ", ".join(Path(str(scene)).name for scene in scenes if scene) or "synthetic room",
        "ground_truth": data.get("ground_truth"),
        "features": data["extractor"]["class_path"].rpartition(".")[2],
    }


def _draw_map(localizer: Localizer, source: str | Path) -> Json | None:
    """The map from above; None without a map, and for exported folders."""
    if Path(source).is_dir():
        return None
    from lightning_pose.localization.trained_system import TrainedSystem  # torch, which exported folders do without

    system = localizer.system
    network = system.model.map_network if isinstance(system, TrainedSystem) else None
    if network is None or not len(network.position):
        return None
    point_map, to_world = network.point_map, system.model.world_frame.to_world
    points, position = (to_world(torch.from_numpy(array)).numpy() for array in (point_map.points, point_map.position))
    return view_from_above(points, point_map.rotation, position)
