"""A landmark map of a small synthetic room, in a checkpoint, and test images of the room."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from lightning import Trainer

from lightning_pose.data import ImageDataModule
from lightning_pose.features import SURF
from lightning_pose.models import LandmarkMap
from lightning_pose.scenes.images import read_rgb
from lightning_pose.scenes.synthetic import render_room

__all__ = ["MappedRoom", "write_video"]


@dataclass(frozen=True)
class MappedRoom:
    """A room with a map of it; not to be changed.

    Attributes:
        root: the scene's folder.
        checkpoint: of a `LandmarkMap`.
        images: of the test frames, in order.
        position_m: (N, 3), of the test frames.
        quat_wxyz: (N, 4), of the test frames.
    """

    root: Path
    checkpoint: Path
    images: list[Path]
    position_m: np.ndarray
    quat_wxyz: np.ndarray

    @classmethod
    def make(cls, folder: Path) -> MappedRoom:
        """Render the room and build its map."""
        root = render_room(folder / "room", frames=45, size=(320, 240))
        extractor = SURF(200, with_geometry=True)
        data = ImageDataModule(extractor, str(root), val_fraction=0, cache_dir=str(folder / "cache"))
        model = LandmarkMap(input_shape=[200, 68], bundle_adjust=False)
        trainer = Trainer(
            max_epochs=1, accelerator="cpu", logger=False, enable_checkpointing=False, enable_progress_bar=False,
            enable_model_summary=False,
        )  # fmt: skip
        trainer.fit(model, datamodule=data)
        trainer.save_checkpoint(folder / "map.ckpt", weights_only=True)
        frames = [data.scene.frames[i] for i in data.scene.splits["test"]]
        return cls(
            root,
            folder / "map.ckpt",
            [frame.image for frame in frames],
            np.array([frame.position_m for frame in frames]),
            np.array([frame.quat_wxyz for frame in frames]),
        )

    def read(self, number: int) -> np.ndarray:
        """(H, W, 3) RGB of a test image."""
        return read_rgb(self.images[number])


def write_video(path: Path, images: list[np.ndarray], fps: float = 10.0) -> Path:
    """Write (H, W, 3) RGB images as a video."""
    height, width = images[0].shape[:2]
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), fps, (width, height))
    for image in images:
        writer.write(cv2.cvtColor(image, cv2.COLOR_RGB2BGR))
    writer.release()
    return path
