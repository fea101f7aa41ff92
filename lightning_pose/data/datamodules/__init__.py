"""From scenes on disk to batches: one data module for single images, one for clips."""

from lightning_pose.data.datamodules.base import SceneDataModule
from lightning_pose.data.datamodules.clips import ClipDataModule
from lightning_pose.data.datamodules.images import ImageDataModule

__all__ = ["ClipDataModule", "ImageDataModule", "SceneDataModule"]
