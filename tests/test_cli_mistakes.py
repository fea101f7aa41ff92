"""A user's mistakes: each ends in one line that names the value and the remedy, exit code 2, and no failed run."""

from __future__ import annotations

import re
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml

from tests.helpers import REPOSITORY, Trained, Workplace

Complaint = Callable[..., str]
FRAME = "seq-01/frame-000003"


@pytest.fixture
def complaint(workplace: Workplace, capsys: pytest.CaptureFixture[str]) -> Complaint:
    """Run a command that must be refused, and give back the one line that says why."""

    def run(*args: object) -> str:
        assert workplace.command(*args) == 2
        lines = [line for line in capsys.readouterr().err.splitlines() if "features ━" not in line]
        assert len(lines) == 1, lines
        assert workplace.runs() == []
        return lines[0].removeprefix("error: ")

    return run


def empty_folder(root: Path) -> None:
    shutil.rmtree(root)
    root.mkdir()


def missing_sequence(root: Path) -> None:
    (root / "TrainSplit.txt").write_text("sequence1\nsequence9\n")


def missing_image(root: Path) -> None:
    (root / f"{FRAME}.color.png").unlink()


def unreadable_image(root: Path) -> None:
    (root / f"{FRAME}.color.png").write_bytes(b"not a picture")


def empty_split(root: Path) -> None:
    (root / "TestSplit.txt").write_text("")


def bad_pose(row: int, column: int, value: float) -> Callable[[Path], None]:
    def damage(root: Path) -> None:
        matrix = np.loadtxt(root / f"{FRAME}.pose.txt")
        matrix[row, column] = value
        np.savetxt(root / f"{FRAME}.pose.txt", matrix)

    return damage


@pytest.mark.parametrize(
    ("damage", "says"),
    [
        pytest.param(empty_folder, "{root} holds no dataset .*give the folder", id="no dataset"),
        pytest.param(shutil.rmtree, "{root} is not a folder; give", id="no folder"),
        pytest.param(missing_sequence, "sequence9.*seq-09 is missing; unzip", id="missing sequence"),
        pytest.param(missing_image, rf"{FRAME}.pose.txt has no image .*; add it or drop", id="missing image"),
        pytest.param(
            unreadable_image, rf"{FRAME}.color.png is .*not an image .*; copy it again", id="unreadable image"
        ),
        pytest.param(bad_pose(0, 3, np.nan), rf"{FRAME}.pose.txt.*NaN.*nan.*; remove", id="pose with NaN"),
        pytest.param(bad_pose(1, 1, 3.0), rf"{FRAME}.pose.txt.*no rotation.*8.*; correct", id="no rotation"),
        pytest.param(empty_split, "TestSplit.txt is empty; list", id="empty split"),
    ],
)
def test_data(
    damage: Callable[[Path], None], says: str, complaint: Complaint, workplace: Workplace, tmp_path: Path
) -> None:
    root = Path(shutil.copytree(workplace.scene, tmp_path / "broken"))
    damage(root)
    line = complaint("fit", "--config", workplace.config, "--data.root", root)
    assert re.search(says.format(root=re.escape(str(root))), line), line


@pytest.mark.parametrize(
    ("args", "says"),
    [
        (["--model.units", "abc"], "units.*int.*abc"),
        (["--model.units", "0"], "units is 0; give 1 or more"),
        (["--model.cell", "lstn"], "cell.*'lstm', 'gru', 'rnn'.*lstn"),
        (["--model.dropout", "2"], "dropout.*between 0 and 1.*2"),
        (["--model.learning_rate", "-1"], "learning_rate is -1.0; give"),
        (["--model.loss.orientation_weight", "-1"], "orientation_weight is -1.0; give"),
        (["--trainer.max_epochs", "x"], "max_epochs.*int.*x"),
        (["--data.batch_size", "0"], "batch_size is 0; give 1 or more"),
        (["--data.val_fraction", "2"], "val_fraction is 2.0; give a part between 0 and 1"),
        (["--data.workers", "0"], "workers is 0; give"),
        (["--data.format", "8scenes"], "'8scenes' is unknown; the formats are .*7scenes"),
        (["--model.unitz", "8"], "unitz.*--help"),
        (["--datum", "8"], "--datum.*--help"),
        (["--config"], "config.*expected"),
        (["--trainer.accelerator", "cuda"], "cuda|CUDA|gpu"),
        (["--trainer.devices", "0"], r"devices='0'.* is not a valid input.*--help"),
        (["--trainer.enable_checkpointing", "false"], "enable_checkpointing=False.*--help"),
        (["--trainer.strategy", "none"], "strategy='none'.*--help"),
        (["--trainer.limit_train_batches", "2.5"], "2.5 for limit_train_batches.*--help"),
        (["--trainer.profiler", "nothing"], "profiler.*'simple'"),
        (["--trainer.max_time", "soon"], "duration='soon'.*DD:HH:MM:SS"),
        (["--trainer.accumulate_grad_batches", "0"], "accumulate_grad_batches is 0; give 1 or more"),
        (["--trainer.check_val_every_n_epoch", "0"], "check_val_every_n_epoch is 0; give 1 or more"),
    ],
)
def test_setting(args: list[str], says: str, complaint: Complaint, workplace: Workplace) -> None:
    line = complaint("fit", "--config", workplace.config, *args)
    assert re.search(says, line), line


@pytest.mark.parametrize(
    ("before", "after", "says"),
    [
        ("units:", "unitz:", "unitz.*--help"),
        ("units: 8", "units: abc", "units.*int.*abc"),
        ("max_epochs", "max_epoch", "max_epoch.*--help"),
        ("SurfLSTM", "SurfLSTN", "SurfLSTN"),
        ("tests.helpers", "tests.helperz", "tests.helperz"),
        ("trainer:", "trainer: [", "parsing"),
    ],
)
def test_setting_in_the_file(
    before: str, after: str, says: str, complaint: Complaint, workplace: Workplace, tmp_path: Path
) -> None:
    file = tmp_path / "changed.yaml"
    file.write_text(workplace.config.read_text().replace(before, after))
    line = complaint("fit", "--config", file)
    assert re.search(says, line), line


def test_config_that_does_not_exist(complaint: Complaint) -> None:
    assert re.search("does not exist: .*nowhere.yaml", complaint("fit", "--config", "nowhere.yaml"))


def test_config_that_is_no_text(complaint: Complaint, tmp_path: Path) -> None:
    (tmp_path / "binary.yaml").write_bytes(b"\xff\xfe\x00")
    assert re.search(r"config.*not text.*; give a YAML file", complaint("fit", "--config", tmp_path / "binary.yaml"))


@pytest.mark.parametrize("verb", ["test", "validate", "predict"])
@pytest.mark.parametrize("with_config", [True, False])
def test_no_checkpoint(verb: str, with_config: bool, complaint: Complaint, workplace: Workplace) -> None:
    config = ["--config", workplace.config] if with_config else []
    assert f"{verb} needs a checkpoint; give it with --ckpt_path" in complaint(verb, *config)


def test_no_value_for_the_checkpoint(complaint: Complaint) -> None:
    assert re.search("ckpt_path.*expected one argument", complaint("test", "--ckpt_path"))


@pytest.mark.parametrize("verb", ["fit", "test", "validate", "predict"])
def test_checkpoint_that_cannot_be_read(
    verb: str, complaint: Complaint, workplace: Workplace, trained: Trained, tmp_path: Path
) -> None:
    def refused(file: Path) -> str:
        return complaint(verb, "--config", workplace.config, "--ckpt_path", file)

    file = tmp_path / "some.ckpt"
    assert f"{file} is no file; give a checkpoint" in refused(file)
    file.write_bytes(b"garbage")
    assert f"{file} cannot be read as a checkpoint; it is damaged" in refused(file)
    file.write_bytes(trained.last.read_bytes()[:-1000])
    assert f"{file} cannot be read as a checkpoint; it is damaged" in refused(file)
    torch.save({"state_dict": {}}, file)
    assert f"{file} was not written by lightning_pose; give a checkpoint that `fit` wrote" in refused(file)


@pytest.mark.parametrize("verb", ["fit", "test"])
def test_checkpoint_of_another_architecture(verb: str, complaint: Complaint, trained: Trained) -> None:
    config = REPOSITORY / "configs" / "surf_cnn.yaml"
    line = complaint(verb, "--config", config, "--data.root", trained.workplace.scene, "--ckpt_path", trained.last)
    assert str(trained.last) in line
    assert re.search("holds a SurfLSTM.*asks for SurfCNN; give the config it was trained with", line)


def test_weights_without_the_rest_cannot_go_on(complaint: Complaint, workplace: Workplace, trained: Trained) -> None:
    line = complaint("fit", "--config", workplace.config, "--ckpt_path", trained.best)
    assert f"{trained.best} holds weights only" in line
    assert "give the last.ckpt beside it" in line


def test_a_finished_run_cannot_go_on(complaint: Complaint, workplace: Workplace, trained: Trained) -> None:
    line = complaint("fit", "--config", workplace.config, "--ckpt_path", trained.last)
    assert f"{trained.last} has 2 epochs behind it and trainer.max_epochs is 2; raise --trainer.max_epochs" in line


def test_an_architecture_for_other_data(complaint: Complaint, workplace: Workplace) -> None:
    line = complaint("fit", "--config", workplace.config, "--model", "lightning_pose.models.CNN3D")
    assert "CNN3D reads clips, but ImageDataModule gives images; set data.class_path to" in line
    assert line.endswith("lightning_pose.data.ClipDataModule")
    clips = ["--config", REPOSITORY / "configs" / "cnn_rnn.yaml", "--data.root", workplace.scene]
    line = complaint("fit", *clips, "--data.relative_frame", "world")
    assert "integrate composes camera motions, but data.relative_frame is world; set camera" in line


def test_no_last_run(complaint: Complaint, workplace: Workplace) -> None:
    line = complaint("fit", "--config", workplace.config, "--ckpt_path", "last")
    assert re.search(rf"no run of SurfLSTM on data.root={workplace.scene} .*; leave --ckpt_path out", line)
    line = complaint("fit", "--config", workplace.config, "--ckpt_path", "last", "--trainer.logger", "false")
    assert re.search("trainer.logger is off.*; name the checkpoint", line)


@pytest.mark.parametrize("verb", ["fit", "test"])
def test_features_of_another_width(
    verb: str, workplace: Workplace, trained: Trained, capsys: pytest.CaptureFixture[str]
) -> None:
    wider = ["--data.extractor.columns", "10", "--ckpt_path", trained.last]
    assert workplace.run(verb, "--trainer.max_epochs", "3", *wider) == 2
    line = capsys.readouterr().err.splitlines()[-1]
    told = {
        "fit": r"data.extractor.columns is 10(.0)? and was 8(.0)?, but a run goes on with",
        "test": r"\(1, 8\) in the checkpoint and \(1, 10\) here; .*data.extractor",
    }
    assert re.search(told[verb], line), line


def test_no_validation_frames(complaint: Complaint, trained: Trained) -> None:
    line = complaint("validate", "--ckpt_path", trained.best, "--data.val_fraction", "0")
    assert re.search("no validation frames; .*val_fraction", line), line


def test_a_model_that_reads_other_features(complaint: Complaint, workplace: Workplace) -> None:
    line = complaint("fit", "--config", workplace.config, "--data.extractor", "tests.features.helpers.ColorMeans")
    assert re.search(r"SurfLSTM reads features with 2 axes, not of shape \(3,\); choose another", line), line


def test_a_class_that_is_no_architecture(complaint: Complaint, workplace: Workplace) -> None:
    line = complaint("fit", "--config", workplace.config, "--model", "lightning_pose.data.ImageDataModule")
    assert re.search("ImageDataModule.*PoseModule", line), line


@pytest.mark.parametrize("name", ["trainer", "report"])
def test_a_section_without_settings(name: str, complaint: Complaint, workplace: Workplace) -> None:
    """Such as one whose lines are all commented out."""
    config = yaml.safe_load(workplace.config.read_text()) | {name: None}
    workplace.config.write_text(yaml.safe_dump(config))
    assert complaint("fit", "--config", workplace.config) == (
        f"{name} has no settings; give some, or leave its line out of the config"
    )
