"""Default places of files (caches of features and rooms, the MLflow database), and files that are never torn."""

from __future__ import annotations

import os
from contextlib import suppress
from pathlib import Path

from platformdirs import user_cache_path

__all__ = ["STORE_VARIABLE", "cache_folder", "default_tracking_uri", "replace_file"]


def cache_folder(name: str) -> Path:
    """The folder `name` in `$LIGHTNING_POSE_CACHE`, or else in the user's cache folder (`~/.cache/lightning_pose`)."""
    base = os.environ.get("LIGHTNING_POSE_CACHE")
    return (Path(base).expanduser() if base else user_cache_path("lightning_pose", appauthor=False)) / name


STORE_VARIABLE = "MLFLOW_TRACKING_URI"


def default_tracking_uri(root: str | Path = "mlruns") -> str:
    """`MLFLOW_TRACKING_URI` if it is set, or else the address of an SQLite database in the folder `root`."""
    return os.environ.get(STORE_VARIABLE) or f"sqlite:///{Path(root) / 'mlflow.db'}"


def replace_file(file: Path, data: bytes | memoryview, temporary: Path, sync: bool = False) -> None:
    """Write a file under a temporary name and rename it, so that no process reads a part of it; make its folder.

    Args:
        file: the old one, if there is one, stays as it is until the new one is complete.
        data: content of the new one.
        temporary: a file in the same folder; it is deleted if the data cannot be written.
        sync: wait until the disk has the data, so that a power failure leaves the old file or the new one.

    Raises:
        OSError: the folder cannot be written, or the disk is full.
    """
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        with temporary.open("wb") as opened:
            opened.write(data)
            if sync:
                opened.flush()
                os.fsync(opened.fileno())
        temporary.replace(file)
    except BaseException:
        with suppress(OSError):
            temporary.unlink()
        raise
    if sync:
        _sync_folder(file.parent)


def _sync_folder(folder: Path) -> None:
    """Wait until the disk has a folder's names, where the system can."""
    with suppress(OSError):  # Windows does not open folders
        number = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(number)
        finally:
            os.close(number)
