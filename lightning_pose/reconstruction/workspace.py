"""The folder that a reconstruction writes: what it keeps between two calls, and which settings it is of."""

from __future__ import annotations

import json
import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pycolmap

from lightning_pose.errors import DataError
from lightning_pose.paths import replace_file

__all__ = ["Workspace", "open_workspace"]

WORK = "reconstruction"
"""The folder of the database and of models before they are joined; it may be deleted when the scene is done."""

FORMAT = 1
"""Raised when the files of an older version cannot be gone on with."""


@dataclass(frozen=True)
class Workspace:
    """Places in the folder of a reconstruction.

    Attributes:
        root: the folder, which `fit --data.root` reads.
        changed: settings that differ from those of the files that were there, which have been deleted; None if there
            were none, empty if this call goes on.
    """

    root: Path
    changed: tuple[str, ...] | None

    @property
    def images(self) -> Path:
        return self.root / "images"

    @property
    def work(self) -> Path:
        return self.root / WORK

    @property
    def database(self) -> Path:
        return self.work / "database.db"

    @property
    def model(self) -> Path:
        return self.root / "sparse" / "0"

    @property
    def summary(self) -> Path:
        return self.root / "reconstruction.json"

    def read(self, name: str) -> Any:
        """A value that an earlier call kept; None if there is none."""
        try:
            return json.loads((self.work / f"{name}.json").read_text())
        except (OSError, ValueError):
            return None

    def keep(self, name: str, value: Any) -> None:
        """Keep a value in plain types."""
        write_json(self.work / f"{name}.json", value)

    def read_model(self) -> pycolmap.Reconstruction | None:
        """The model that an earlier call kept, in its own unit."""
        return pycolmap.Reconstruction(self._kept) if self._kept.is_dir() else None

    def keep_model(self, model: pycolmap.Reconstruction) -> None:
        """Keep a finished model."""
        part = self._kept.with_suffix(".tmp")
        shutil.rmtree(part, ignore_errors=True)
        part.mkdir()
        model.write(part)
        part.rename(self._kept)

    def clear_results(self) -> None:
        """Delete features, matches and models, because the frames are others."""
        shutil.rmtree(self._kept, ignore_errors=True)
        self.database.unlink(missing_ok=True)

    @property
    def _kept(self) -> Path:
        return self.work / "final"


def write_json(file: Path, value: Any) -> None:
    """Write a value in plain types, never in part."""
    replace_file(file, (json.dumps(value, indent=1) + "\n").encode(), file.with_suffix(".tmp"))


def open_workspace(root: Path, settings: dict[str, Any]) -> Workspace:
    """Make the folder of a reconstruction, or go on in it if its settings are the same; else begin anew in it.

    Args:
        root: the folder.
        settings: what features, matches and poses depend on, in plain types.

    Raises:
        DataError: the folder has files that no reconstruction has written.
    """
    settings = json.loads(json.dumps(settings | {"format": FORMAT}))
    fresh = Workspace(root, None)
    old = fresh.read("settings")
    if old is None and root.exists() and (not root.is_dir() or any(root.iterdir())) and not fresh.work.is_dir():
        raise DataError(f"{root} is there and was not written by `reconstruct`; give the name of a new folder")
    if old == settings:
        return Workspace(root, ())
    if old is not None:
        for place in (fresh.work, fresh.images, root / "sparse"):
            shutil.rmtree(place, ignore_errors=True)
        fresh.summary.unlink(missing_ok=True)
    fresh.work.mkdir(parents=True, exist_ok=True)
    fresh.keep("settings", settings)
    names = sorted(name for name in {*settings, *(old or {})} if old is None or settings.get(name) != old.get(name))
    return Workspace(root, None if old is None else tuple(names))
