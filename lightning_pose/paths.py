"""Default places of files: caches of features and synthetic rooms, and the MLflow database."""

from __future__ import annotations

import os
from pathlib import Path

from platformdirs import user_cache_path

__all__ = ["STORE_VARIABLE", "cache_folder", "default_tracking_uri"]


def cache_folder(name: str) -> Path:
    """The folder `name` in `$LIGHTNING_POSE_CACHE`, or else in the user's cache folder (`~/.cache/lightning_pose`)."""
    base = os.environ.get("LIGHTNING_POSE_CACHE")
    return (Path(base).expanduser() if base else user_cache_path("lightning_pose", appauthor=False)) / name


STORE_VARIABLE = "MLFLOW_TRACKING_URI"


def default_tracking_uri(root: str | Path = "mlruns") -> str:
    """`MLFLOW_TRACKING_URI` if it is set, or else the address of an SQLite database in the folder `root`."""
    return os.environ.get(STORE_VARIABLE) or f"sqlite:///{Path(root) / 'mlflow.db'}"
