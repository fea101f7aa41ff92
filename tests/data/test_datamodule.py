"""The trainer's data module: where it is found, and what is said where there is none."""

from __future__ import annotations

from pathlib import Path

import pytest
from lightning import LightningDataModule, Trainer

from lightning_pose.data import (
    ClipDataModule,
    ImageDataModule,
    find_datamodule,
    require_clips,
    scene_datamodule,
)
from lightning_pose.errors import ConfigError
from lightning_pose.models import SurfLSTM
from tests.helpers import Thumbnails


def trainer_with(datamodule: LightningDataModule | None) -> Trainer:
    trainer = Trainer(accelerator="cpu", logger=False, enable_checkpointing=False)
    vars(trainer)["datamodule"] = datamodule
    return trainer


def test_the_data_module_of_a_trainer(tmp_path: Path) -> None:
    data = ImageDataModule(Thumbnails(), root=str(tmp_path))
    assert find_datamodule(trainer_with(data)) is scene_datamodule(trainer_with(data)) is data


@pytest.mark.parametrize(
    ("datamodule", "message"),
    [(None, "is missing; give it"), (LightningDataModule(), "is a LightningDataModule; give")],
)
def test_a_trainer_without_one_is_refused(datamodule: LightningDataModule | None, message: str) -> None:
    trainer = trainer_with(datamodule)
    assert find_datamodule(trainer) is None
    with pytest.raises(ConfigError, match=f"the trainer's data module {message}"):
        scene_datamodule(trainer)
    model = SurfLSTM(input_shape=[6, 8], units=4)
    model.trainer = trainer
    model.setup("test")  # nothing is learnt, and batches may come from elsewhere
    with pytest.raises(ConfigError, match=f"the trainer's data module {message}"):
        model.setup("fit")


def test_clips_are_required_where_images_are_given(tmp_path: Path) -> None:
    clips = ClipDataModule(Thumbnails(), root=str(tmp_path))
    assert require_clips(clips) is clips
    with pytest.raises(ConfigError, match=r"ImageDataModule gives images, not clips; set data\.class_path to"):
        require_clips(ImageDataModule(Thumbnails(), root=str(tmp_path)))
