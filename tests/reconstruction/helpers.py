"""A scene of points that eight cameras see, as pycolmap makes it, with its database."""

from __future__ import annotations

from pathlib import Path

import pycolmap

from lightning_pose.reconstruction.agreement import MatchedPair
from lightning_pose.reconstruction.find_poses import read_pairs

__all__ = ["make_model"]


def make_model(folder: Path, frames: int = 8, points: int = 150) -> tuple[pycolmap.Reconstruction, list[MatchedPair]]:
    """A model without noise, and its matches, which are also in `folder/database.db`."""
    pycolmap.set_random_seed(1)
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_cameras_per_rig, options.num_frames_per_rig = 1, 1, frames
    options.num_points3D = points
    database = folder / "database.db"
    with pycolmap.Database.open(database) as opened:
        model = pycolmap.synthesize_dataset(options, opened)
    return model, read_pairs(database)
