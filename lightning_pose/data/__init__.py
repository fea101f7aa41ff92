"""Scenes and features as batches: data modules for single images and for clips."""

from lightning_pose.data.clip_datamodule import ClipDataModule
from lightning_pose.data.datamodule import SceneDataModule
from lightning_pose.data.image_datamodule import ImageDataModule

__all__ = ["ClipDataModule", "ImageDataModule", "SceneDataModule"]
