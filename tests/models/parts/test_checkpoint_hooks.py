"""What a checkpoint carries of the frames that its weights depend on."""

from __future__ import annotations

import pytest
import torch
from lightning import Trainer

from lightning_pose import models
from lightning_pose.models.parts import checkpoint_hooks
from lightning_pose.models.parts.checkpoint_hooks import LEARNT_FRAMES, key_frame
from tests.models.helpers import WallProblem, make_model


def test_checkpoints_carry_the_keys_of_training_frames_and_compute_them_once(monkeypatch: pytest.MonkeyPatch) -> None:
    calls: list[int] = []
    monkeypatch.setattr(checkpoint_hooks, "key_frame", lambda frame: calls.append(1) or key_frame(frame))
    model, data = make_model(models.LandmarkMap, refit=False), WallProblem([250, 36])
    trainer = Trainer(logger=False, enable_checkpointing=False, accelerator="cpu", enable_model_summary=False)
    model.trainer = trainer
    trainer.datamodule = data  # pyright: ignore[reportAttributeAccessIssue]
    saved = [dict[str, torch.Tensor](), dict[str, torch.Tensor]()]
    for checkpoint in saved:
        model.on_save_checkpoint(checkpoint)
    scene = data.scene
    expected = sorted(key_frame(scene.frames[i]) for i in scene.splits["train"])
    assert saved[0][LEARNT_FRAMES].tolist() == saved[1][LEARNT_FRAMES].tolist() == expected
    assert len(calls) == len(expected)
