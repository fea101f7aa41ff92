"""Exported folders of a map and of a refined regressor: the checkpoint's answers, and what is refused."""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from lightning import Trainer

from lightning_pose.__main__ import main
from lightning_pose.checkpoint import read_checkpoint
from lightning_pose.data import ImageDataModule
from lightning_pose.errors import CheckpointError, ConfigError
from lightning_pose.export.agreement import Agreement, compare_answers
from lightning_pose.export.frames import find_run_frames
from lightning_pose.export.runner.checksums import sign_facts
from lightning_pose.export.runner.system import FORMAT_VERSION, ExportedSystem
from lightning_pose.export.runner.system import read_facts as read_signed_facts
from lightning_pose.features import CNN
from lightning_pose.localization.localizer import Localizer
from lightning_pose.localization.located_pose import LocatedPose
from lightning_pose.localization.trained_system import TrainedSystem
from lightning_pose.models import LinearPoseNet
from lightning_pose.runs.process import name_owner
from tests.export.helpers import BACKBONE, COLUMNS
from tests.rooms import MappedRoom


def export(*args: object) -> int:
    return main(["export", *map(str, args)])


@pytest.fixture(scope="module")
def folder(mapped_room: MappedRoom, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The room's map, exported; not to be changed."""
    out = tmp_path_factory.mktemp("exported") / "room"
    assert export(mapped_room.checkpoint, "--out", out) == 0
    return out


@pytest.fixture
def copied(folder: Path, tmp_path: Path) -> Path:
    """A copy of the folder, to be changed."""
    return Path(shutil.copytree(folder, tmp_path / "copy"))


def read_facts(folder: Path) -> dict[str, Any]:
    return json.loads((folder / "localizer.json").read_text())


def ask_alone(folder: Path, *args: object) -> subprocess.CompletedProcess[str]:
    """Run the folder's own file in a Python that sees nothing of this repository."""
    return subprocess.run(
        [sys.executable, "-I", folder / "localizer.py", *map(str, args)], capture_output=True, text=True, check=False
    )


def check_same(ours: LocatedPose, theirs: LocatedPose) -> None:
    np.testing.assert_allclose(theirs.position_m, ours.position_m, atol=1e-3)
    np.testing.assert_allclose(np.abs(theirs.quat_wxyz @ ours.quat_wxyz), 1, atol=1e-6)
    assert (theirs.status, theirs.source, theirs.reason) == (ours.status, ours.source, ours.reason)
    np.testing.assert_allclose([theirs.radius_m, theirs.radius_deg], [ours.radius_m, ours.radius_deg], rtol=0.02)
    assert theirs.to_dict().keys() == ours.to_dict().keys()
    if ours.covariance is not None:
        assert theirs.covariance is not None
        assert np.abs(theirs.covariance - ours.covariance).max() < 0.05 * np.abs(ours.covariance).max()


def test_the_folder_has_what_it_needs(folder: Path, mapped_room: MappedRoom) -> None:
    assert sorted(file.name for file in folder.iterdir()) == [
        "localizer.json", "localizer.py", "map.safetensors", "requirements.txt",
    ]  # fmt: skip
    facts = read_facts(folder)
    assert facts["format_version"] == FORMAT_VERSION
    assert facts["system"] == "LandmarkMap"
    assert facts["ground_truth"] == "original"
    assert facts["map"]["camera"]["width"] == 320
    assert facts["training_data"]["frames"] == facts["map"]["training_frames"] > 10
    assert len(facts["training_data"]["fingerprint"]) == 32
    assert facts["agreement"]["images"] == min(20, len(mapped_room.images))
    assert list(folder.parent.iterdir()) == [folder]


def test_answers_are_those_of_the_checkpoint(folder: Path, mapped_room: MappedRoom) -> None:
    ours, theirs = Localizer.load(mapped_room.checkpoint), Localizer.load(folder)
    turned = np.ascontiguousarray(np.rot90(mapped_room.read(0)))
    small = cv2.resize(mapped_room.read(1), None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
    blank = np.full((240, 320, 3), 9, np.uint8)
    for image in (*mapped_room.images[:3], mapped_room.read(2), small, blank):
        check_same(ours.localize(image), theirs.localize(image))
    assert theirs.localize(blank).status == "refused"
    prior = ours.localize(mapped_room.images[0])
    check_same(ours.localize(mapped_room.images[1], prior=prior), theirs.localize(mapped_room.images[1], prior=prior))
    for localizer in (ours, theirs):
        with pytest.raises(ConfigError, match="240x320 pixels, and its camera is for 320x240"):
            localizer.localize(turned)
    np.testing.assert_array_equal(ours.system.read_map_points(), theirs.system.read_map_points())


def test_the_file_alone_answers_as_the_checkpoint(folder: Path, mapped_room: MappedRoom, tmp_path: Path) -> None:
    (tmp_path / "text.png").write_text("no image")
    found = ask_alone(folder, *mapped_room.images[:2], tmp_path / "text.png")
    assert found.returncode == 2
    assert "text.png is truncated or is not an image" in found.stderr
    assert "Traceback" not in found.stderr
    poses = [json.loads(line) for line in found.stdout.splitlines()]
    for pose, image in zip(poses, mapped_room.images, strict=False):
        expected = Localizer.load(mapped_room.checkpoint).localize(image)
        assert pose.keys() == expected.to_dict().keys()
        np.testing.assert_allclose(pose["position_m"], expected.position_m, atol=1e-3)
        assert pose["inliers"] > 20


def test_the_verb_localize_reads_a_folder(
    folder: Path, mapped_room: MappedRoom, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["localize", str(folder), str(mapped_room.images[0]), "--format", "jsonl"]) == 0
    assert json.loads(capsys.readouterr().out)["source"] == "map"


def test_a_regressor_with_a_map_in_one_folder(mapped_room: MappedRoom, tmp_path: Path) -> None:
    pytest.importorskip("onnxscript", reason="the extra `export` is not installed")
    extractor = CNN(BACKBONE, size=32, crop="whole")
    data = ImageDataModule(extractor, str(mapped_room.root), val_fraction=0, cache_dir=str(tmp_path / "cache"))
    model = LinearPoseNet(input_shape=[COLUMNS], lambdas=[1.0], refine={"n_features": 150, "bundle_adjust": False})
    trainer = Trainer(
        max_epochs=1, accelerator="cpu", logger=False, enable_checkpointing=False, enable_progress_bar=False,
        enable_model_summary=False,
    )  # fmt: skip
    trainer.fit(model, datamodule=data)
    trainer.save_checkpoint(tmp_path / "refined.ckpt", weights_only=True)
    out = tmp_path / "out"
    assert export(tmp_path / "refined.ckpt", "--out", out, "--images", *mapped_room.images[:3]) == 2
    assert not out.exists(), "the checkpoint names a class of ours"
    allow = ("--allow", BACKBONE)
    assert export(tmp_path / "refined.ckpt", "--out", out, "--images", *mapped_room.images[:3], *allow) == 0
    assert {"model.onnx", "map.safetensors"} <= {file.name for file in out.iterdir()}
    ours, theirs = Localizer.load(tmp_path / "refined.ckpt", allow=BACKBONE), Localizer.load(out)
    blank = np.full((240, 320, 3), 9, np.uint8)
    for image in (mapped_room.images[3], blank):
        check_same(ours.localize(image), theirs.localize(image))
    assert (theirs.localize(blank).source, theirs.localize(mapped_room.images[3]).source) == ("network", "map")
    assert (
        export(tmp_path / "refined.ckpt", "--out", tmp_path / "8", "--int8", "--images", mapped_room.images[0], *allow)
        == 2
    )
    assert not (tmp_path / "8").exists()


def test_answers_that_differ_are_not_written(
    mapped_room: MappedRoom, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    from lightning_pose.export import map_files

    original = map_files.save_file

    def move_points(arrays: dict[str, np.ndarray], path: Path) -> None:
        original(arrays | {"points": arrays["points"] + 0.01, "position": arrays["position"] + 0.01}, path)

    monkeypatch.setattr(map_files, "save_file", move_points)
    assert export(mapped_room.checkpoint, "--out", tmp_path / "out") == 2
    assert (
        "from the checkpoint's; at most 0.001 in the scene's unit and 0.05 deg are allowed, and nothing was written"
        in capsys.readouterr().err
    )
    assert not list(tmp_path.iterdir())


def test_agreement_in_units_of_the_scene() -> None:
    pose = LocatedPose(np.zeros(3), np.array([1.0, 0, 0, 0]))
    moved = LocatedPose(np.array([0.0, 0, 0.5]), np.array([-np.cos(1e-4), 0, 0, np.sin(1e-4)]))
    found = compare_answers([pose, pose], [pose, moved])
    assert found.position_m == 0.5
    assert found.orientation_deg == pytest.approx(np.degrees(2e-4), rel=1e-6)
    found.check(scale=1000.0)
    with pytest.raises(ConfigError, match=r"up to 0.5 and 0.011 deg"):
        found.check(scale=1.0)
    with pytest.raises(ConfigError, match=r"accepts other images than the checkpoint: 1 of 2, the first is a.png"):
        Agreement(2, 0.0, 0.0, ("a.png",)).check(1.0)


def test_a_metre_of_a_scene_without_metres(mapped_room: MappedRoom, tmp_path: Path) -> None:
    poses = [np.eye(4) for _ in range(4)]
    for pose, x in zip(poses, (-8, -4, 4, 8), strict=True):
        pose[0, 3] = x
    frames = [
        {"file_path": str(image), "transform_matrix": pose.tolist()}
        for image, pose in zip(mapped_room.images[:4], poses, strict=True)
    ]
    (tmp_path / "transforms.json").write_text(json.dumps({"fl_x": 300, "frames": frames}))
    data = read_checkpoint(mapped_room.checkpoint)["lightning_pose"]["data"]
    system = TrainedSystem.from_checkpoint(mapped_room.checkpoint)
    assert find_run_frames(system, data, (), str(tmp_path)).metre == pytest.approx(np.sqrt(40))
    assert find_run_frames(system, data, (), None).metre is None


def test_a_folder_is_not_written_over(folder: Path, copied: Path, mapped_room: MappedRoom, tmp_path: Path) -> None:
    assert export(mapped_room.checkpoint, "--out", copied) == 2
    (copied / "map.safetensors").unlink()
    assert export(mapped_room.checkpoint, "--out", copied, "--overwrite") == 0
    assert sorted(file.name for file in copied.iterdir()) == sorted(file.name for file in folder.iterdir())
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "thesis.txt").touch()
    assert export(mapped_room.checkpoint, "--out", tmp_path / "mine", "--overwrite") == 2
    assert [file.name for file in (tmp_path / "mine").iterdir()] == ["thesis.txt"]


def test_what_killed_exports_have_left_is_deleted(copied: Path, mapped_room: MappedRoom) -> None:
    ended = subprocess.Popen(["true"])
    ended.wait()
    owners = name_owner(ended.pid), name_owner(), "0123456789ab-1", "0123456789ab-2"
    killed, running, old, elsewhere = left = [copied.parent / f".{copied.name}.{name}.abc.exporting" for name in owners]
    for each in left:
        each.mkdir()
    os.utime(old, (0, 0))
    assert export(mapped_room.checkpoint, "--out", copied, "--overwrite") == 0
    assert [each.exists() for each in (killed, running, old, elsewhere)] == [False, True, False, True]


def test_mistakes_are_one_line(mapped_room: MappedRoom, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "out"
    for args, message in (
        ((mapped_room.checkpoint, "--out", out, "--int8"), "LandmarkMap has no network, whose weights --int8"),
        ((mapped_room.checkpoint, "--out", out, "--root", tmp_path), "are not to be found"),
        ((mapped_room.checkpoint, "--out", out, "--images", tmp_path), "--images names no image"),
        ((tmp_path / "none.ckpt", "--out", out), "does not exist"),
        ((mapped_room.checkpoint,), "--out"),
    ):
        assert export(*args) == 2
        error = capsys.readouterr().err
        assert message in error
        assert error.count("\n") == 1
    assert not out.exists()


def change_facts(**changes: Any) -> Callable[[Path], None]:
    def change(folder: Path) -> None:
        (folder / "localizer.json").write_text(json.dumps(sign_facts(read_facts(folder) | changes)))

    return change


def flip_byte(name: str, place: int) -> Callable[[Path], None]:
    def flip(folder: Path) -> None:
        data = bytearray((folder / name).read_bytes())
        data[place] ^= 1
        (folder / name).write_bytes(data)

    return flip


def forget_checksum(folder: Path) -> None:
    """As one damaged byte in its name would."""
    facts = read_facts(folder)
    del facts["sha256"]
    (folder / "localizer.json").write_text(json.dumps(facts))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            change_facts(format_version=99),
            r"has format 99, and this version reads up to 2; use the localizer.py in the",
        ),
        (change_facts(format_version=0), r"has format 0, which is not read any more; export the model again"),
        (change_facts(format="something"), r"is no localizer that `export` wrote"),
        (change_facts(map={"file": "map.safetensors"}), r"localizer.json lacks 'keypoints'; export the model again"),
        (lambda folder: (folder / "localizer.json").write_text("{"), r"cannot be read as a localizer"),
        (lambda folder: (folder / "localizer.json").write_text("[]"), r"cannot be read as a localizer"),
        (lambda folder: (folder / "map.safetensors").unlink(), r"map.safetensors cannot be read"),
        (flip_byte("map.safetensors", -9), r"map.safetensors is damaged \(its checksum differs\); copy it again"),
        (forget_checksum, r"localizer.json is damaged"),
    ],
)
def test_a_folder_that_cannot_be_asked_says_why(copied: Path, change: Callable[[Path], None], message: str) -> None:
    change(copied)
    with pytest.raises(CheckpointError, match=message):
        ExportedSystem(copied)
    found = ask_alone(copied, "a.png")
    assert found.returncode == 2
    assert found.stderr.startswith("error: ")
    assert found.stderr.count("\n") == 1


def test_damage_of_one_byte_changes_no_answer(copied: Path) -> None:
    facts, data = read_facts(copied), (copied / "localizer.json").read_bytes()
    for place in range(0, len(data), 7):
        flip_byte("localizer.json", place)(copied)
        with contextlib.suppress(CheckpointError):
            assert read_signed_facts(copied) == facts, place
        (copied / "localizer.json").write_bytes(data)
    assert read_signed_facts(copied) == facts
    flip_byte("localizer.py", 100)(copied)  # in its docstring
    found = ask_alone(copied, "a.png")
    assert (found.returncode, found.stdout) == (2, "")
    assert "localizer.py is damaged" in found.stderr


def test_a_folder_without_checksums_is_read(copied: Path) -> None:
    """As earlier versions wrote it."""
    facts = {name: value for name, value in read_facts(copied).items() if name not in ("files", "sha256")}
    (copied / "localizer.json").write_text(json.dumps(facts))
    assert ExportedSystem(copied).name == "LandmarkMap"


def test_no_code_of_a_folder_is_run(copied: Path, mapped_room: MappedRoom, tmp_path: Path) -> None:
    """A stranger's folder may have any file; only its facts and arrays are read."""
    evil = f"open({str(tmp_path / 'ran')!r}, 'w')\n"
    for name in ("localizer.py", "__init__.py", "sitecustomize.py", "lightning_pose.py", "numpy.py"):
        (copied / name).write_text(evil)
    Localizer.load(copied).localize(mapped_room.images[0])
    assert not (tmp_path / "ran").exists()


@pytest.mark.parametrize("name", ["../map.safetensors", "/etc/passwd", "parts/map.safetensors"])
def test_a_folder_names_its_own_files_only(copied: Path, name: str) -> None:
    facts = read_facts(copied)
    change_facts(map=facts["map"] | {"file": name})(copied)
    with pytest.raises(CheckpointError, match="names a file outside the folder"):
        ExportedSystem(copied)


def test_locating_with_a_folder_imports_no_torch(folder: Path, mapped_room: MappedRoom) -> None:
    code = (
        "import sys; from lightning_pose.__main__ import main; main(['localize', *sys.argv[1:]])\n"
        "print([name for name in ('torch', 'lightning') if name in sys.modules])"
    )
    command = [sys.executable, "-c", code, folder, mapped_room.images[0]]
    found = subprocess.run(command, capture_output=True, text=True, check=False)
    assert found.stdout.splitlines()[-1] == "[]", found.stderr
    assert "1 of 1 images located" in found.stderr
