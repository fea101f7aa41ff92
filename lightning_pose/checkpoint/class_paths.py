"""Class paths of older checkpoints and configs, and today's."""

from __future__ import annotations

from collections.abc import Mapping

__all__ = ["RENAMED_CLASSES", "resolve_class_path", "resolve_class_paths"]

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
