"""Checkpoints on disk: never torn, on a full disk neither, and damage is noticed before training goes on."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from lightning import Trainer

from lightning_pose.checkpoint import read_checkpoint
from lightning_pose.errors import CheckpointError
from lightning_pose.runs.checkpoint_files import CheckpointFiles, use_checkpoint_files
from tests.helpers import Trained, Workplace, limit_file_size

BIG = {"lightning_pose": {}, "state_dict": {"weight": torch.zeros(100_000)}}
SMALL = {"lightning_pose": {}, "state_dict": {"weight": torch.ones(1)}}


def test_a_full_disk_leaves_the_old_file(tmp_path: Path) -> None:
    file = tmp_path / "last.ckpt"
    CheckpointFiles().save_checkpoint(SMALL, file)
    message = r"cannot write .*last.ckpt \(File too large\); free some space, or .*default_root_dir; the one of an ear"
    with limit_file_size(10_000), pytest.raises(CheckpointError, match=message):
        CheckpointFiles().save_checkpoint(BIG, file)
    assert read_checkpoint(file)["state_dict"]["weight"].tolist() == [1]
    assert [found.name for found in tmp_path.iterdir()] == ["last.ckpt"]


def test_a_killed_process_leaves_the_old_file(tmp_path: Path) -> None:
    """It is gone while it writes beside the old file; what it leaves is overwritten by the next one."""
    file = tmp_path / "last.ckpt"
    CheckpointFiles().save_checkpoint(SMALL, file)
    (tmp_path / "last.ckpt.tmp").write_bytes(b"half a checkpoint")
    assert read_checkpoint(file)["state_dict"]["weight"].tolist() == [1]
    CheckpointFiles().save_checkpoint(BIG, file)
    assert len(read_checkpoint(file)["state_dict"]["weight"]) == 100_000
    assert [found.name for found in tmp_path.iterdir()] == ["last.ckpt"]


def test_nothing_is_written_into_the_temporary_folder(workplace: Workplace, monkeypatch: pytest.MonkeyPatch) -> None:
    """It may be on another file system, from which a file can only be copied over the good one."""
    moved: list[tuple[Path, Path]] = []
    rename = Path.replace

    def note(self: Path, target: Path) -> Path:
        moved.append((self, target))
        return rename(self, target)

    monkeypatch.setattr(Path, "replace", note)
    assert workplace.run("fit") == 0
    checkpoints = [(old, new) for old, new in moved if new.suffix == ".ckpt"]
    assert {new.name for _, new in checkpoints} == {"best.ckpt", "last.ckpt"}
    assert all(old.parent == new.parent for old, new in checkpoints)


def test_training_on_a_full_disk_ends_in_one_line(workplace: Workplace, capsys: pytest.CaptureFixture[str]) -> None:
    assert workplace.run("fit") == 0
    size = max(file.stat().st_size for file in workplace.folder.rglob("mlflow.db"))
    capsys.readouterr()
    with limit_file_size(size + 50_000):  # the store may grow
        assert workplace.run("fit", "--model.units", 300) == 2
    error = capsys.readouterr().err
    assert "File too large" in error.splitlines()[-1]
    assert "Traceback" not in error
    assert workplace.runs()[0].info.status == "FAILED"


def test_training_does_not_go_on_from_a_damaged_file(trained: Trained, tmp_path: Path) -> None:
    damaged = bytearray(trained.last.read_bytes())
    damaged[len(damaged) // 2] ^= 1
    (tmp_path / "last.ckpt").write_bytes(damaged)
    with pytest.raises(CheckpointError, match="is damaged"):
        CheckpointFiles().load_checkpoint(tmp_path / "last.ckpt")


def test_another_way_of_a_user_s_own_is_kept() -> None:
    class Own(CheckpointFiles):
        pass

    trainer = Trainer(accelerator="cpu", logger=False, enable_checkpointing=False, plugins=[own := Own()])
    use_checkpoint_files(trainer)
    assert trainer.strategy.checkpoint_io is own


def test_a_folder_that_cannot_be_made_is_refused_before_training(
    workplace: Workplace, capfd: pytest.CaptureFixture[str]
) -> None:
    (workplace.folder / "taken").write_text("a file where the folder would be")
    assert workplace.run("fit", "--trainer.default_root_dir", "taken") == 2
    output = "".join(capfd.readouterr())
    assert "choose another folder with --trainer.default_root_dir" in output
    assert "epoch 1/" not in output
