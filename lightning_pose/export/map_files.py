"""What an exported folder has of a landmark map: its arrays as safetensors, and its facts."""

from __future__ import annotations

import math
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any

import numpy as np
from safetensors.numpy import save_file

from lightning_pose.errors import ConfigError
from lightning_pose.features import AKAZE, BRIEF, FREAK, ORB, SIFT, SURF, FeatureExtractor
from lightning_pose.models.parts.map_network import MapNetwork

__all__ = ["MAP_FILE", "describe_keypoints", "write_map"]

MAP_FILE = "map.safetensors"


def write_map(network: MapNetwork, extractor: FeatureExtractor, folder: Path) -> dict[str, Any]:
    """Write a map's arrays into a folder.

    Returns:
        what `localizer.json` has of the map.
    """
    point_map = network.point_map
    arrays = {field.name: np.ascontiguousarray(getattr(point_map, field.name)) for field in fields(point_map)}
    save_file(arrays, folder / MAP_FILE)
    return {
        "file": MAP_FILE,
        "keypoints": describe_keypoints(extractor),
        "camera": asdict(network.view),
        "calibration": [None if math.isnan(factor) else factor for factor in network.calibration.tolist()],
        "points": len(point_map),
        "training_frames": len(point_map.position),
    }


def describe_keypoints(extractor: FeatureExtractor) -> dict[str, Any]:
    """Settings of a local extractor as the runner reads them.

    Raises:
        ConfigError: the runner has no such extractor.
    """
    facts: dict[str, Any] = {"name": type(extractor).__name__}
    if isinstance(extractor, SURF):
        facts |= {"upright": extractor.upright, "threshold": extractor.threshold}
    elif isinstance(extractor, SIFT):
        facts["threshold"] = extractor.contrast_threshold
    elif isinstance(extractor, AKAZE):
        facts["threshold"] = extractor.threshold
    elif isinstance(extractor, ORB | FREAK | BRIEF):
        facts["threshold"] = extractor.fast_threshold
    else:
        raise ConfigError(
            f"features of {type(extractor).__name__} cannot be exported: the runner has SURF, SIFT, ORB, AKAZE, FREAK, "
            "BRIEF, Pixels and CNNs"
        )
    return facts | {
        "n_features": extractor.n_features,
        "columns": extractor.descriptor_dim,
        "with_geometry": extractor.with_geometry,
    }
