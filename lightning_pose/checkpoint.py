"""Checkpoint files, and the objects in them as plain specs (class path and arguments).

A spec is what config files write: `describe_object` makes it from an object, `build_object` the object from it.
`read_checkpoint` reads a file that `fit` wrote; class paths of older versions are replaced by today's.
"""

from __future__ import annotations

import inspect
import sys
from collections.abc import Mapping
from importlib import import_module
from pathlib import Path
from typing import Any

import torch

from lightning_pose.errors import CheckpointError

__all__ = [
    "RENAMED_CLASSES",
    "Spec",
    "build_object",
    "class_path",
    "describe_object",
    "read_checkpoint",
    "resolve_class_path",
    "resolve_class_paths",
]

Spec = dict[str, Any]
"""`{"class_path": "package.module.Class", "init_args": {...}}`, plain types only."""

_MODELS = {
    "cnn_3d": "CNN3D",
    "cnn_rnn": "CNNRNN",
    "dense_posenet": "DensePoseNet",
    "graph_pose": "GraphPose",
    "kernel_posenet": "KernelPoseNet",
    "linear_posenet": "LinearPoseNet",
    "node_pose": "NodePose",
    "posenet": "PoseNet",
    "surf_cnn": "SurfCNN",
    "surf_lstm": "SurfLSTM",
}

RENAMED_CLASSES = {
    **{f"lightning_pose.models.{module}.{name}": f"lightning_pose.models.{name}" for module, name in _MODELS.items()},
    "lightning_pose.features.classical.BRIEF": "lightning_pose.features.BRIEF",
    "lightning_pose.features.classical.FREAK": "lightning_pose.features.FREAK",
    "lightning_pose.features.classical.ORB": "lightning_pose.features.ORB",
    "lightning_pose.features.classical.SIFT": "lightning_pose.features.SIFT",
    "lightning_pose.features.cnn.CNN": "lightning_pose.features.CNN",
    "lightning_pose.features.pixels.Pixels": "lightning_pose.features.Pixels",
    "lightning_pose.features.surf.SURF": "lightning_pose.features.SURF",
    "lightning_pose.data.datamodules.ImageDataModule": "lightning_pose.data.ImageDataModule",
    "lightning_pose.data.datamodules.ClipDataModule": "lightning_pose.data.ClipDataModule",
    "lightning_pose.data.datamodules.images.ImageDataModule": "lightning_pose.data.ImageDataModule",
    "lightning_pose.data.datamodules.clips.ClipDataModule": "lightning_pose.data.ClipDataModule",
    "lightning_pose.tracking.MLflowLogger": "lightning_pose.runs.logger.MLflowLogger",
}
"""Class paths in older checkpoints and configs, to today's. A path that is listed here must never name a new class."""


def resolve_class_path(path: str) -> str:
    """Today's class path for one in an older file; the path itself if it was never renamed."""
    return RENAMED_CLASSES.get(path, path)


def resolve_class_paths(config: object) -> object:
    """Copy a config's or a spec's nested values, with each class path replaced by today's.

    Configs name a class by `class_path` or by a bare string, as in `extractor: lightning_pose.features.SURF`.
    """
    if isinstance(config, Mapping):
        return {key: resolve_class_paths(value) for key, value in config.items()}
    if isinstance(config, list):
        return [resolve_class_paths(value) for value in config]
    return resolve_class_path(config) if isinstance(config, str) else config


def class_path(obj: object) -> str:
    """The path by which users import an object's class: its name in the outermost package that exports it.

    `lightning_pose.models.SurfLSTM`, not `lightning_pose.models.surf_lstm.SurfLSTM`, so that files stay readable
    when a module moves. A class that no package exports is named by its module.
    """
    cls = type(obj)
    parts = cls.__module__.split(".")
    for length in range(2, len(parts)):  # not the top package, which exports lazily
        package = ".".join(parts[:length])
        if getattr(sys.modules.get(package), cls.__qualname__, None) is cls:
            return f"{package}.{cls.__qualname__}"
    return f"{cls.__module__}.{cls.__qualname__}"


def describe_object(obj: object) -> Spec:
    """Make the spec of an object that keeps every constructor argument as an attribute of the same name."""
    names = inspect.signature(type(obj)).parameters
    return {"class_path": class_path(obj), "init_args": {name: getattr(obj, name) for name in names}}


def build_object(spec: Mapping[str, Any]) -> Any:
    """Make the object that a spec describes.

    Raises:
        CheckpointError: the class cannot be imported here, or does not take these arguments.
    """
    path = resolve_class_path(spec["class_path"])
    module, _, name = path.rpartition(".")
    try:
        return getattr(import_module(module), name)(**spec["init_args"])
    except (ImportError, AttributeError, ValueError) as error:
        raise CheckpointError(f"{path} cannot be imported ({error}); install the package that has it") from error
    except TypeError as error:
        raise CheckpointError(
            f"{path} does not take the saved settings ({error}); it was saved by another version, train it again"
        ) from error


def read_checkpoint(path: str | Path) -> dict[str, Any]:
    """Read a checkpoint that `fit` wrote: tensors are memory-mapped on the CPU, class paths are today's.

    Raises:
        CheckpointError: the file is missing, unreadable, or was not written by this project.
    """
    path = Path(path)
    if not path.is_file():
        raise CheckpointError(f"{path} is no file; give a checkpoint such as mlruns/checkpoints/RUN_ID/best.ckpt")
    try:
        checkpoint = torch.load(path, map_location="cpu", weights_only=True, mmap=True)
    except Exception as error:  # torch raises many kinds of exception for a file that is no checkpoint
        raise CheckpointError(
            f"{path} cannot be read as a checkpoint; it is damaged or another kind of file"
        ) from error
    if not isinstance(checkpoint, dict) or "lightning_pose" not in checkpoint:
        raise CheckpointError(f"{path} was not written by lightning_pose; give a checkpoint that `fit` wrote")
    return checkpoint | {"lightning_pose": resolve_class_paths(checkpoint["lightning_pose"])}
