"""Where the project keeps what it can make again: features and synthetic rooms."""

from __future__ import annotations

import os
from pathlib import Path

from platformdirs import user_cache_path

__all__ = ["cache_folder"]


def cache_folder(name: str) -> Path:
    """`name` in `$LIGHTNING_POSE_CACHE`, or else in the user's cache folder (`~/.cache/lightning_pose`)."""
    base = os.environ.get("LIGHTNING_POSE_CACHE")
    return (Path(base).expanduser() if base else user_cache_path("lightning_pose", appauthor=False)) / name
