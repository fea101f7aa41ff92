"""Scenes and features as batches: data modules for single images and for clips."""

from lightning_pose.data.clip_datamodule import ClipDataModule, require_clips
from lightning_pose.data.datamodule import SceneDataModule, find_datamodule, scene_datamodule
from lightning_pose.data.image_datamodule import ImageDataModule

__all__ = [
    "ClipDataModule",
    "ImageDataModule",
    "SceneDataModule",
    "find_datamodule",
    "require_clips",
    "scene_datamodule",
]
