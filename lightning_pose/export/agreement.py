"""Whether an exported folder gives the answers of its checkpoint, on real frames."""

from __future__ import annotations

import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from importlib.machinery import SourceFileLoader
from importlib.util import module_from_spec, spec_from_loader
from pathlib import Path
from types import ModuleType

import numpy as np

from lightning_pose.errors import ConfigError
from lightning_pose.localization.localizer import Localizer
from lightning_pose.localization.located_pose import LocatedPose

__all__ = ["MOST_DEG", "MOST_M", "Agreement", "compare_answers", "load_runner", "locate_images"]

MOST_M, MOST_DEG = 1e-3, 0.05
"""How far an exported folder's answers may be from those of its checkpoint: rounding can decide whether one match is an
inlier, and a map of few points then answers a little differently."""


@dataclass(frozen=True)
class Agreement:
    """How answers to the same images differ.

    Attributes:
        images: how many were compared.
        position_m: largest difference, in the scene's unit.
        orientation_deg: largest difference.
        other_status: names of images that only one accepts, or that come from another part of the system.
    """

    images: int
    position_m: float
    orientation_deg: float
    other_status: tuple[str, ...]

    def check(self, scale: float) -> None:
        """Refuse answers that differ.

        Args:
            scale: what counts as a metre, in the scene's unit.

        Raises:
            ConfigError: they do.
        """
        if self.other_status:
            raise ConfigError(
                f"the exported model accepts other images than the checkpoint: {len(self.other_status)} of "
                f"{self.images}, the first is {self.other_status[0]}; nothing was written"
            )
        if not (self.position_m <= MOST_M * scale and self.orientation_deg <= MOST_DEG):
            raise ConfigError(
                f"the exported model's answers to {self.images} images are up to {self.position_m:.2g} and "
                f"{self.orientation_deg:.2g} deg from the checkpoint's; at most {MOST_M * scale:.2g} in the scene's "
                f"unit and {MOST_DEG:g} deg are allowed, and nothing was written"
            )


def locate_images(localizer: Localizer, images: Sequence[Path]) -> list[LocatedPose]:
    """A pose for each image; of a model of clips, they are one video."""
    return localizer.localize(list(images))


def compare_answers(ours: Sequence[LocatedPose], theirs: Sequence[LocatedPose]) -> Agreement:
    """How two systems' answers to the same images differ."""
    position = [np.linalg.norm(a.position_m - b.position_m) for a, b in zip(ours, theirs, strict=True)]
    turned = [measure_angle_deg(a, b) for a, b in zip(ours, theirs, strict=True)]
    other = [str(a.image) for a, b in zip(ours, theirs, strict=True) if (a.status, a.source) != (b.status, b.source)]
    return Agreement(len(ours), float(max(position)), float(max(turned)), tuple(other))


def measure_angle_deg(a: LocatedPose, b: LocatedPose) -> float:
    """Angle between two orientations, also where it is tiny."""
    half_chord = min(np.linalg.norm(a.quat_wxyz - b.quat_wxyz), np.linalg.norm(a.quat_wxyz + b.quat_wxyz)) / 2
    return float(np.degrees(4 * np.arcsin(min(half_chord, 1.0))))


@contextmanager
def load_runner(folder: Path) -> Iterator[ModuleType]:
    """The folder's `localizer.py`, which has just been written; folders of others are never run."""
    loader = _Uncached("exported_localizer", str(folder / "localizer.py"))
    spec = spec_from_loader(loader.name, loader)
    assert spec is not None
    module = module_from_spec(spec)
    sys.modules[spec.name] = module  # dataclasses look their module up
    try:
        loader.exec_module(module)
        yield module
    finally:
        del sys.modules[spec.name]


class _Uncached(SourceFileLoader):
    """Loads a file, and leaves no bytecode beside it."""

    def set_data(self, path: str, data: bytes, *, _mode: int = 0o666) -> None:
        """Python would write the bytecode here."""
