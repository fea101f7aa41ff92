"""CheckpointHooks: what a module's checkpoints carry beside its weights, and which checkpoints it refuses."""

from __future__ import annotations

import hashlib
from typing import Any

import numpy as np
import torch
from lightning import LightningModule

from lightning_pose.checkpoint import Spec, class_path, resolve_class_path
from lightning_pose.data.datamodule import SceneDataModule, find_datamodule
from lightning_pose.errors import CheckpointError
from lightning_pose.scenes.scene import Frame, Scene

__all__ = ["LEARNT_FRAMES", "CheckpointHooks", "key_frame"]

LEARNT_FRAMES = "learnt_frames"
"""Entry of a checkpoint: (M,) int64, `key_frame` of each frame that the weights depend on."""


def key_frame(frame: Frame) -> int:
    """A number in 64 bits that identifies a frame by its pose, wherever the dataset is, and however it is split."""
    pose = np.concatenate([frame.position_m, frame.quat_wxyz]).round(6) + 0.0  # no negative zero
    return int.from_bytes(hashlib.blake2b(pose.tobytes(), digest_size=8).digest(), "little", signed=True)


class CheckpointHooks(LightningModule):
    """Mixin of `PoseModule`: adds specs of the module and its data to its checkpoints, and checks those it loads."""

    _learnt: tuple[Scene, torch.Tensor] | None = None

    @property
    def training_splits(self) -> tuple[str, ...]:
        """The splits whose poses end up in the weights; the image retrieval baseline searches the same."""
        return ("train",)

    def describe(self) -> Spec:
        """Plain settings that rebuild this module; checkpoints carry them."""
        return {"class_path": class_path(self), "init_args": dict(self.hparams)}

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Refuse a checkpoint that does not suit this module, before any weight is loaded.

        Raises:
            CheckpointError: it is of another architecture, or its tensors have other shapes.
        """
        saved = checkpoint.get("lightning_pose", {}).get("model", {}).get("class_path", class_path(self))
        saved = resolve_class_path(saved)
        if saved != class_path(self):
            raise CheckpointError(
                f"the checkpoint holds a {saved.rpartition('.')[2]}, not a {type(self).__name__}; "
                "give the config it was trained with"
            )
        own = self.state_dict()
        for name, value in checkpoint["state_dict"].items():
            if name in own and own[name].shape != value.shape:
                raise CheckpointError(
                    f"{name} has shape {tuple(value.shape)} in the checkpoint and {tuple(own[name].shape)} here; "
                    "give the settings it was trained with, data.extractor included"
                )

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Add the specs of the module and its data, from which `Localizer` rebuilds both."""
        datamodule = find_datamodule(self.trainer)
        checkpoint["lightning_pose"] = {
            "model": self.describe(),
            "data": datamodule.describe() if datamodule is not None else None,
        }
        if datamodule is not None and datamodule.scene is not None:  # a data module of tensors alone has no scene
            checkpoint[LEARNT_FRAMES] = self._list_learnt_frames(datamodule)

    def _list_learnt_frames(self, datamodule: SceneDataModule) -> torch.Tensor:
        """(M,) int64, the keys of the frames of `training_splits`; two checkpoints an epoch need them."""
        scene = datamodule.scene
        if self._learnt is None or self._learnt[0] is not scene:
            rows = [int(i) for split in self.training_splits for i in scene.splits[split]]
            keys = sorted(key_frame(scene.frames[i]) for i in rows)
            self._learnt = scene, torch.tensor(keys, dtype=torch.int64)
        return self._learnt[1]
