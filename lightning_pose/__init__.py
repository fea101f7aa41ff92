"""Cheap camera localization: a folder of posed images in, a trained and measured localizer out.

    from lightning_pose import Localizer, load_scene

These names are imported on first use, so that `import lightning_pose` does not import torch.

The data goes one way, and imports follow it:

- `errors`, `paths`, `threads`, `geometry`: exceptions, where files are kept, threads, quaternions and poses
- `scenes`: a folder on disk -> `Scene`
- `features`: images -> SURF and other descriptors, cached
- `data`: Scene + features -> batches
- `losses`, `metrics`, `models`: the architectures, one file each
- `localization`: a checkpoint -> poses of images
- `export`: a trained system -> a folder that runs without torch
- `serving`: a localizer behind HTTP
- `runs`, `figures`, `evaluation`: MLflow, and what every test ends with
- `sweeps`, `studies`, `reports`: tuning, the thesis's figures, tables of finished runs
- `cli`, `commands`: what users run
"""

from __future__ import annotations

import os
from importlib import import_module
from importlib.metadata import PackageNotFoundError, version
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from lightning_pose.localization.localizer import Localizer
    from lightning_pose.models import (
        CNN3D,
        CNNRNN,
        DensePoseNet,
        GraphPose,
        KernelPoseNet,
        LandmarkMap,
        LinearPoseNet,
        NodePose,
        PoseNet,
        SurfCNN,
        SurfLSTM,
    )
    from lightning_pose.scenes.formats import load_scene

__all__ = [
    "CNN3D",
    "CNNRNN",
    "DensePoseNet",
    "GraphPose",
    "KernelPoseNet",
    "LandmarkMap",
    "LinearPoseNet",
    "Localizer",
    "NodePose",
    "PoseNet",
    "SurfCNN",
    "SurfLSTM",
    "__version__",
    "load_scene",
]

_MODULES = {"Localizer": "lightning_pose.localization.localizer", "load_scene": "lightning_pose.scenes.formats"}
"""Where the names that are no architectures are defined; the architectures come from `lightning_pose.models`."""

if "OMP_WAIT_POLICY" not in os.environ:
    # Threads of torch that have nothing to do spin for the next work, and take the core from the thread that should
    # bring it: on two busy cores SURF took ten times as long. They sleep after this many rounds, some 0.05 ms.
    # Read when torch is loaded; without effect where the program has done so before.
    os.environ.setdefault("GOMP_SPINCOUNT", "1000")

try:
    __version__ = version("lightning-camera-localization")
except PackageNotFoundError:  # run from a checkout that was not installed
    __version__ = "0+unknown"


def __getattr__(name: str) -> Any:
    """Import one of the names in `__all__` on its first use (PEP 562)."""
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(import_module(_MODULES.get(name, "lightning_pose.models")), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
