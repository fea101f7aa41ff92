"""Images to features: our own SURF, other descriptors from OpenCV, frozen CNNs, pixels, and the feature cache.

`base` describes how to add an extractor. The names below are imported on first use, all at once, so that modules such
as `matching` do not import torch, and so that any of them makes all extractors known to the command line.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from lightning_pose.features.base import FeatureExtractor, LocalExtractor
    from lightning_pose.features.cache import FeatureCache, FillReport
    from lightning_pose.features.cnn import CNN
    from lightning_pose.features.opencv import AKAZE, BRIEF, FREAK, ORB, SIFT
    from lightning_pose.features.pixels import Pixels
    from lightning_pose.features.surf import SURF

__all__ = [
    "AKAZE",
    "BRIEF",
    "CNN",
    "FREAK",
    "ORB",
    "SIFT",
    "SURF",
    "FeatureCache",
    "FeatureExtractor",
    "FillReport",
    "LocalExtractor",
    "Pixels",
]

_MODULES = {
    "base": ("FeatureExtractor", "LocalExtractor"),
    "cache": ("FeatureCache", "FillReport"),
    "cnn": ("CNN",),
    "opencv": ("AKAZE", "BRIEF", "FREAK", "ORB", "SIFT"),
    "pixels": ("Pixels",),
    "surf": ("SURF",),
}
"""Where the names in `__all__` are defined."""


def __getattr__(name: str) -> Any:
    """Import the names in `__all__` on the first use of one of them (PEP 562)."""
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    for module, names in _MODULES.items():
        found = import_module(f"{__name__}.{module}")
        globals().update({each: getattr(found, each) for each in names})
    return globals()[name]


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
