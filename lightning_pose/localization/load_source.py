"""Where a localizer comes from: a checkpoint, a run, a registered model, or an exported folder."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from lightning_pose.localization.localizer import LocatingSystem

__all__ = ["load_system"]


def load_system(source: str | Path, allow: Sequence[str], tracking_uri: str | None) -> LocatingSystem:
    """Load what `Localizer.load` is given.

    Raises:
        CheckpointError: it cannot be read, or names a class that is not allowed.
        ConfigError: it is neither of these.
    """
    path = Path(source).expanduser()
    if path.is_dir():
        return _load_exported(path)
    from lightning_pose.localization.trained_system import TrainedSystem  # torch, which takes seconds to import

    return TrainedSystem.from_checkpoint(path, allow)


def _load_exported(folder: Path) -> LocatingSystem:
    """The system of a folder that `export` wrote, without torch; code in the folder is not run."""
    from lightning_pose.export.runner.system import ExportedSystem

    return ExportedSystem(folder)
