"""Checkpoints on disk: never torn, on a full disk neither, and damage is noticed before training goes on."""

from __future__ import annotations

import subprocess
from contextlib import nullcontext
from pathlib import Path

import pytest
import torch
from lightning import Trainer

from lightning_pose.checkpoint import read_checkpoint
from lightning_pose.errors import CheckpointError
from lightning_pose.runs import pace
from lightning_pose.runs.checkpoint_files import CheckpointFiles, use_checkpoint_files
from lightning_pose.runs.process import name_owner
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


def test_a_killed_process_leaves_the_old_file(workplace: Workplace) -> None:
    """It is gone while it writes beside the old file; what it leaves is deleted by the next training."""
    assert workplace.run("fit") == 0
    (run,) = workplace.runs()
    file = workplace.checkpoint(run, "last")
    ended = subprocess.Popen(["true"])
    ended.wait()
    killed, running = (file.with_name(f"last.ckpt.{name_owner(each)}.tmp") for each in (ended.pid, None))
    for each in (killed, running):
        each.write_bytes(b"half a checkpoint")
    assert read_checkpoint(file)["state_dict"]
    assert workplace.run("fit") == 0
    assert (killed.exists(), running.exists()) == (False, True)


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


def make_busy_files() -> CheckpointFiles:
    """Whose last write was so slow that the next one is not due for seconds."""
    files = CheckpointFiles()
    files._pace._next = float("inf")
    return files


def test_of_what_is_held_the_newest_is_written(tmp_path: Path) -> None:
    files, events = make_busy_files(), []
    files.before_write = lambda: events.append(sorted(file.name for file in tmp_path.iterdir()))
    weight = torch.zeros(1)
    with files.hold():
        for value in (1.0, 2.0):
            weight.fill_(value)
            files.save_checkpoint({"lightning_pose": {}, "state_dict": {"weight": weight}}, tmp_path / "last.ckpt")
    weight.fill_(3.0)  # training goes on
    assert not list(tmp_path.iterdir())
    files.flush()
    files.flush()
    assert events == [[]]
    assert read_checkpoint(tmp_path / "last.ckpt")["state_dict"]["weight"].tolist() == [2]


def test_what_is_held_is_a_copy_in_the_memory_of_an_earlier_one(tmp_path: Path) -> None:
    files, weight = make_busy_files(), torch.zeros(3)
    ways: list[int] = []
    for number in range(6):
        weight.fill_(number)
        state = {"weight": weight, "steps": [weight.clone(), {"number": number}]}
        with files.hold():
            files.save_checkpoint({"lightning_pose": {}, "state_dict": state}, tmp_path / "last.ckpt")
        weight.fill_(-1)  # training goes on
        (held,) = files._held.values()
        ways.append(held["state_dict"]["weight"].data_ptr())
        if number == 3:
            files.flush()
            files._pace._next = float("inf")
            assert read_checkpoint(tmp_path / "last.ckpt")["state_dict"]["weight"].tolist() == [3, 3, 3]
    files.flush()
    read = read_checkpoint(tmp_path / "last.ckpt")["state_dict"]
    assert read["weight"].tolist() == read["steps"][0].tolist() == [5, 5, 5]
    assert read["steps"][1] == {"number": 5}
    assert len(set(ways)) == 1
    assert weight.data_ptr() not in ways


def test_outside_hold_a_checkpoint_is_written_at_once(tmp_path: Path) -> None:
    make_busy_files().save_checkpoint(SMALL, tmp_path / "own.ckpt")
    assert read_checkpoint(tmp_path / "own.ckpt")["state_dict"]["weight"].tolist() == [1]


@pytest.mark.parametrize("callback", ["tests.helpers.FailAt", None])
def test_short_epochs_are_on_the_disk_when_training_ends(
    callback: str | None, workplace: Workplace, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(pace, "SHARE", 1e9)
    monkeypatch.setattr(pace, "LONGEST_S", 1e9)
    words = ["--trainer.max_epochs", "4"]
    if callback is not None:
        words += ["--trainer.callbacks+", callback, "--trainer.callbacks.epoch", "3"]
    with nullcontext() if callback is None else pytest.raises(RuntimeError):
        workplace.run("fit", *words)
    (run,) = workplace.runs()
    for name in ("last", "best"):
        assert workplace.checkpoint(run, name).is_file()
    state = torch.load(workplace.checkpoint(run, "last"), weights_only=True)
    assert state["epoch"] == (3 if callback is None else 2)
    assert len(workplace.client.get_metric_history(run.info.run_id, "train/loss")) == state["epoch"] + 1
