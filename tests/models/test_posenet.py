"""PoseNet: crops, pretrained weights, mixed precision, and its refusals."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch
from lightning import Trainer
from torch import Tensor, nn

from lightning_pose.checkpoint import build_object
from lightning_pose.data.batches import PoseBatch
from lightning_pose.errors import CheckpointError, ConfigError
from lightning_pose.features.backbones import build_backbone
from lightning_pose.losses import LossConfig
from lightning_pose.models import PoseNet
from tests.models.helpers import LearnableProblem, make_model, random_poses

SMALL = "tests.models.helpers.SmallCNN"


class Seen(nn.Module):
    """Remembers the crops that it was shown."""

    def __init__(self) -> None:
        super().__init__()
        self.gain = nn.Parameter(torch.ones(()))
        self.crops: list[Tensor] = []

    def forward(self, rgb: Tensor) -> Tensor:
        self.crops.append(rgb)
        return self.gain * rgb.mean((2, 3))


def numbered_images(count: int, height: int = 16, width: int = 20) -> Tensor:
    """Images whose pixels say where they are: red the row, green the column, blue the image."""
    images = torch.zeros(count, 3, height, width, dtype=torch.uint8)
    images[:, 0] = torch.arange(height, dtype=torch.uint8)[:, None]
    images[:, 1] = torch.arange(width, dtype=torch.uint8)
    images[:, 2] = torch.arange(count, dtype=torch.uint8)[:, None, None]
    return images


def trainer(**settings: Any) -> Trainer:
    return Trainer(max_epochs=1, accelerator="cpu", logger=False, enable_checkpointing=False,
                   enable_progress_bar=False, enable_model_summary=False, **settings)  # fmt: skip


def test_it_sees_the_middle_of_an_image() -> None:
    model = PoseNet(input_shape=[3, 16, 20], backbone=f"{__name__}.Seen", crop=8).eval()
    model(numbered_images(2))
    crop = model.network.cnn.crops[-1] * 255  # type: ignore[union-attr, index, operator]
    assert crop.shape == (2, 3, 8, 8)
    torch.testing.assert_close(crop[1, :, 0, 0], torch.tensor([4.0, 6.0, 1.0]))


def test_it_is_trained_on_random_crops(monkeypatch: pytest.MonkeyPatch) -> None:
    model = PoseNet(input_shape=[3, 16, 20], backbone=f"{__name__}.Seen", crop=8).train()
    monkeypatch.setattr(model, "log_dict", lambda *args, **kwargs: None)
    batch = PoseBatch(numbered_images(64), *random_poses(64), torch.arange(64))
    model.training_step(batch, 0)
    crops = model.network.cnn.crops[-1] * 255  # type: ignore[union-attr, index, operator]
    assert crops.shape == (64, 3, 8, 8)
    rows, columns, image = crops[:, :, 0, 0].round().T
    assert image.tolist() == list(range(64))
    assert (rows.min(), rows.max()) == (0, 8)
    assert (columns.min(), columns.max()) == (0, 12)
    model.eval()
    model.validation_step(batch, 0)
    assert (model.network.cnn.crops[-1][:, 0, 0, 0] * 255 == 4).all()  # type: ignore[union-attr, index]


def test_training_starts_from_the_weights_asked_for(tmp_path: Path) -> None:
    pretrained = build_backbone("mobilenet_v2", "none")
    with torch.no_grad():
        for parameter in pretrained.parameters():
            parameter.fill_(0.01)
    torch.save(pretrained.layers.state_dict(), tmp_path / "weights.pth")  # type: ignore[union-attr]
    model = PoseNet(input_shape=[3, 32, 32], backbone="mobilenet_v2", crop=32, weights=str(tmp_path / "weights.pth"))
    assert not all((parameter == 0.01).all() for parameter in model.network.cnn.parameters())
    attach(model, LearnableProblem([3, 32, 32])).setup("fit")
    assert all((parameter == 0.01).all() for parameter in model.network.cnn.parameters())


def attach(model: PoseNet, problem: LearnableProblem) -> PoseNet:
    model.trainer = trainer()
    model.trainer.datamodule = problem  # type: ignore[attr-defined]
    return model


def test_a_checkpoint_needs_the_pretrained_weights_no_more(tmp_path: Path) -> None:
    gone = str(tmp_path / "gone.pth")
    model = PoseNet(input_shape=[3, 32, 32], backbone="mobilenet_v2", crop=32, weights=gone)
    rebuilt = build_object(model.describe(), allow="tests")
    rebuilt.load_state_dict(model.state_dict())
    images = numbered_images(2, 32, 32)
    torch.testing.assert_close(rebuilt.eval()(images), model.eval()(images))
    with pytest.raises(CheckpointError, match=r"gone\.pth' are no file"):
        attach(model, LearnableProblem([3, 32, 32])).setup("fit")


def test_a_module_that_comes_frozen_is_trained() -> None:
    model = make_model(PoseNet)
    before = [parameter.clone() for parameter in model.network.cnn.parameters()]  # type: ignore[union-attr]
    trainer().fit(model, datamodule=LearnableProblem([3, 12, 12]))
    after = list(model.network.cnn.parameters())  # type: ignore[union-attr]
    assert all((old != new).any() for old, new in zip(before, after, strict=True))
    assert model.network.cnn.layers[1].num_batches_tracked == 3  # type: ignore[union-attr, index]


def test_mixed_precision_leaves_poses_in_single_precision() -> None:
    model = make_model(PoseNet)
    with torch.autocast("cpu", torch.bfloat16):
        pose = model.train().decode_features(torch.rand(4, 3, 12, 12))[0]
    assert pose.dtype == torch.float32
    assert (pose.bfloat16().float() != pose).any()
    trainer(precision="bf16-mixed").fit(model, datamodule=LearnableProblem([3, 12, 12]))


def test_learned_weights_are_learned() -> None:
    model = make_model(PoseNet, loss=LossConfig(form="split", learned_weights=True), learning_rate=0.01)
    trainer().fit(model, datamodule=LearnableProblem([3, 12, 12]))
    assert model.loss.log_scale_position != 0
    assert model.loss.log_scale_orientation != -3


def test_headline_names_what_differs() -> None:
    assert make_model(PoseNet).headline == "SmallCNN 12"


def test_what_cannot_work_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"reads RGB images, not 16 channels; give lightning_pose\.features\.Pixels"):
        PoseNet(input_shape=[16, 32, 32])
    with pytest.raises(ConfigError, match="crop is 224 and images are 32 x 40; give 1 to 32"):
        PoseNet(input_shape=[3, 32, 40])
    with pytest.raises(ConfigError, match=r"units is 0 and dropout 0\.5"):
        PoseNet(input_shape=[3, 12, 12], backbone=SMALL, crop=12, units=0)
    with pytest.raises(ConfigError, match=r"SmallCNN cannot take a crop of 8 .*; give a larger one"):
        PoseNet(input_shape=[3, 12, 12], backbone=SMALL, crop=8)
    with pytest.raises(ConfigError, match="backbone 'resnet51' is not known"):
        PoseNet(input_shape=[3, 12, 12], backbone="resnet51", crop=8)
