"""The command `localize`: inputs, formats, losses of a video, drawings, recordings and exit codes."""

from __future__ import annotations

import contextlib
import csv
import io
import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from lightning_pose.__main__ import main
from lightning_pose.localization.localizer import Localizer
from lightning_pose.localization.located_pose import stack_poses
from lightning_pose.localization.parallel import ModelSource, locate_files
from tests.helpers import REPOSITORY, Trained
from tests.rooms import MappedRoom, write_video


def localize(*args: object, expected: int = 0) -> None:
    assert main(["localize", *map(str, args)]) == expected


@pytest.fixture(scope="module")
def poses(mapped_room: MappedRoom) -> np.ndarray:
    """(N, 7) position and quaternion of the first test images, by the localizer."""
    return np.hstack(stack_poses(Localizer.load(mapped_room.checkpoint).localize(mapped_room.images[:4])))


@pytest.fixture
def folder(mapped_room: MappedRoom, tmp_path: Path) -> Path:
    """Four test images under names in natural order, and a depth image that is none of them."""
    photos = tmp_path / "photos"
    photos.mkdir()
    for i in range(4):
        (photos / f"shot{i + 8}.png").symlink_to(mapped_room.images[i])
    (photos / "shot8.depth.png").symlink_to(mapped_room.images[0])
    return photos


def test_three_formats_say_the_same(folder: Path, mapped_room: MappedRoom, poses: np.ndarray, tmp_path: Path) -> None:
    for ending in ("tum", "jsonl", "csv"):
        localize(mapped_room.checkpoint, folder, "--out", tmp_path / f"out.{ending}")
    lines = [json.loads(line) for line in (tmp_path / "out.jsonl").read_text().splitlines()]
    found = np.array([[*line["position_m"], *line["quat_wxyz"]] for line in lines])
    np.testing.assert_allclose(found, poses, atol=1e-12)
    assert [Path(line["image"]).name for line in lines] == [f"shot{i}.png" for i in (8, 9, 10, 11)]
    with (tmp_path / "out.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    table = np.array([[float(row[name]) for name in ("x_m", "y_m", "z_m", "qw", "qx", "qy", "qz")] for row in rows])
    np.testing.assert_allclose(table, poses, atol=1e-7)
    assert {row["status"] for row in rows} == {"accepted"}
    tum = np.loadtxt(tmp_path / "out.tum")
    np.testing.assert_allclose(tum[:, [1, 2, 3, 7, 4, 5, 6]], poses, atol=1e-8)
    np.testing.assert_array_equal(tum[:, 0], np.arange(4))
    assert f"# {folder}/shot8.png\n" in (tmp_path / "out.tum").read_text()


def test_an_image_that_cannot_be_read_is_refused_and_the_others_go_on(
    folder: Path, mapped_room: MappedRoom, capsys: pytest.CaptureFixture[str]
) -> None:
    (folder / "shot9.png").unlink()
    (folder / "shot9.png").write_bytes(b"")
    localize(mapped_room.checkpoint, folder, "--format", "jsonl", expected=1)
    printed = capsys.readouterr()
    lines = [json.loads(line) for line in printed.out.splitlines()]
    assert [line["status"] for line in lines] == ["accepted", "refused", "accepted", "accepted"]
    assert "shot9.png is empty" in lines[1]["reason"]
    assert lines[1]["position_m"] == [None, None, None]
    assert "3 of 4 images located, 1 refused" in printed.err
    localize(mapped_room.checkpoint, folder, expected=1)
    assert f"# {folder}/shot9.png refused: " in capsys.readouterr().out
    localize(mapped_room.checkpoint, folder, "--format", "csv", expected=1)
    assert ",refused," in capsys.readouterr().out


def test_paths_come_from_standard_input_and_patterns(
    folder: Path, mapped_room: MappedRoom, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("sys.stdin", io.StringIO(f"{folder}/shot8.png\n\n{folder}/gone.png\n"))
    localize(mapped_room.checkpoint, f"{folder}/shot1*.png", "-", "--format", "csv", expected=1)
    rows = list(csv.DictReader(io.StringIO(capsys.readouterr().out)))
    assert [Path(row["image"]).name for row in rows] == ["shot10.png", "shot11.png", "shot8.png", "gone.png"]
    assert "does not exist" in rows[3]["reason"]


def test_a_video_is_lost_and_found_again(
    mapped_room: MappedRoom, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    frames = [mapped_room.read(i) for i in range(8)]
    frames[3:5] = [np.zeros_like(frames[0])] * 2
    video = write_video(tmp_path / "walk.avi", frames)
    options = "--draw", tmp_path / "figures" / "walk.png", "--out", tmp_path / "walk.tum"
    localize(mapped_room.checkpoint, video, *options, expected=1)
    errors = capsys.readouterr().err
    assert f"lost at {video}#000003 (0.30 s): too few features: 0" in errors
    assert f"found again at {video}#000005 (0.50 s), after 2 frames" in errors
    assert "6 of 8 images located, 2 refused" in errors
    rows = np.loadtxt(tmp_path / "walk.tum")
    np.testing.assert_allclose(rows[:, 0], [0.0, 0.1, 0.2, 0.5, 0.6, 0.7], atol=1e-6)
    assert np.median(np.linalg.norm(rows[:, 1:4] - mapped_room.position_m[[0, 1, 2, 5, 6, 7]], axis=1)) < 0.04
    assert (tmp_path / "figures" / "walk.png").read_bytes().startswith(b"\x89PNG")
    localize(mapped_room.checkpoint, video, "--every", 5, "--format", "jsonl")
    times = [json.loads(line)["time_s"] for line in capsys.readouterr().out.splitlines()]
    assert times == pytest.approx([0.0, 0.5], abs=1e-6)


def test_a_video_that_cannot_be_read_is_refused(
    mapped_room: MappedRoom, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "bad.mp4").write_bytes(b"no video")
    localize(mapped_room.checkpoint, tmp_path / "bad.mp4", mapped_room.images[0], "--format", "csv", expected=1)
    rows = list(csv.DictReader(io.StringIO(capsys.readouterr().out)))
    assert [row["status"] for row in rows] == ["refused", "accepted"]
    assert "bad.mp4 cannot be opened as a video" in rows[0]["reason"]


def test_images_as_one_sequence(folder: Path, mapped_room: MappedRoom, capsys: pytest.CaptureFixture[str]) -> None:
    (folder / "shot10.png").unlink()
    (folder / "shot10.png").write_bytes(b"damaged")
    localize(mapped_room.checkpoint, folder, "--sequence", expected=1)
    errors = capsys.readouterr().err
    assert f"lost at {folder}/shot10.png: " in errors
    assert f"found again at {folder}/shot11.png" in errors


def test_a_recording_for_the_viewer(folder: Path, mapped_room: MappedRoom, tmp_path: Path) -> None:
    pytest.importorskip("rerun")
    localize(mapped_room.checkpoint, folder, "--view", tmp_path / "a.rrd", "--out", tmp_path / "a.csv")
    assert (tmp_path / "a.rrd").read_bytes()[:4] == b"RRF2"
    assert (tmp_path / "a.rrd").stat().st_size > 20_000


def test_without_rerun_one_line_says_what_to_install(
    folder: Path, mapped_room: MappedRoom, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    monkeypatch.setitem(sys.modules, "rerun", None)
    localize(mapped_room.checkpoint, folder, "--view", tmp_path / "a.rrd", expected=2)
    assert "--view needs rerun, which is not installed; `uv sync --extra view`" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("args", "message"),
    [
        ([], "no inputs; give images, folders, videos"),
        (["nowhere.png"], "nowhere.png does not exist; give images"),
        (["*.nothing"], "*.nothing matches no file"),
        (["{room}"], "has no images; give one of its folders, such as "),
        (["{image}", "--every", "0"], "--every is 0; give 1"),
        (["{image}", "--workers", "0"], "--workers is 0; give 1"),
        (["{image}", "--camera", "PINHOLE,1"], "camera 'PINHOLE,1' does not have the form"),
        (["{image}", "--out", "{image}/x.csv"], "cannot be written"),
        (["{image}", "--format", "xml"], "invalid choice: 'xml'"),
        (["camera:97"], "camera:97 cannot be opened as a video"),
    ],
)
def test_mistakes_are_one_line(
    args: list[str], message: str, mapped_room: MappedRoom, capsys: pytest.CaptureFixture[str]
) -> None:
    names = {"room": mapped_room.root, "image": mapped_room.images[0]}
    localize(mapped_room.checkpoint, *(arg.format(**names) for arg in args), expected=2)
    errors = capsys.readouterr().err
    assert errors.startswith("error: ")
    assert message in errors
    assert errors.count("\n") == 1


def test_a_model_that_is_none(capsys: pytest.CaptureFixture[str], mapped_room: MappedRoom) -> None:
    localize("none.ckpt", mapped_room.images[0], expected=2)
    assert "none.ckpt does not exist; give a checkpoint such as" in capsys.readouterr().err


def test_a_network_locates_and_refuses_a_camera(
    trained: Trained, scene: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    images = scene / "seq-03"
    localize(trained.best, images, "--allow", "tests", "--format", "csv")
    rows = list(csv.DictReader(io.StringIO(capsys.readouterr().out)))
    assert len(rows) == 10
    assert {row["source"] for row in rows} == {"network"}
    options = "--allow", "tests", "--camera", "PINHOLE,64,48,50,50,31.5,23.5"
    localize(trained.best, images, *options, expected=2)
    assert "SurfLSTM does not use cameras; leave camera out" in capsys.readouterr().err


def test_several_images_at_once_give_the_same_lines(
    trained: Trained, scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("lightning_pose.localization.parallel.PER_TASK", 3)
    images = sorted((scene / "seq-03").glob("*.png"))
    paths = [*map(str, images[:5]), str(tmp_path / "gone.png"), *map(str, images[5:])]
    monkeypatch.setattr("sys.stdin", io.StringIO("\n".join(paths)))
    options = "--allow", "tests", "--format", "csv", "--out", tmp_path / "many.csv"
    localize(trained.best, "-", *options, "--workers", 3, expected=1)
    rows = list(csv.DictReader((tmp_path / "many.csv").open(newline="")))
    assert [row["image"] for row in rows] == paths
    assert [row["status"] for row in rows].index("refused") == 5
    alone = Localizer.load(trained.best, ["tests"]).localize(images)
    again = [pose for pose in locate_files(ModelSource(str(trained.best), ("tests",)), None, paths, 2) if pose.accepted]
    np.testing.assert_allclose(stack_poses(again)[0], stack_poses(alone)[0], atol=1e-6)
    found = np.array([[float(row[name]) for name in ("x_m", "y_m", "z_m")] for row in rows if row["x_m"]])
    np.testing.assert_allclose(found, stack_poses(alone)[0], atol=1e-6)


def test_the_entry_point_stops_at_a_closed_pipe(mapped_room: MappedRoom, tmp_path: Path) -> None:
    """Through a real pipe whose reader leaves after the first line; and `--help` names the exit codes."""
    command = [sys.executable, "-m", "lightning_pose", "localize", str(mapped_room.checkpoint)]
    images = [str(image) for image in mapped_room.images]
    with subprocess.Popen(
        [*command, *images], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd=REPOSITORY
    ) as process:
        assert process.stdout is not None
        assert process.stderr is not None
        assert process.stdout.readline().startswith("# timestamp")
        process.stdout.close()
        errors = process.stderr.read()
        assert process.wait(timeout=120) == 1
    assert "Traceback" not in errors
    with contextlib.redirect_stdout(io.StringIO()) as stdout, pytest.raises(SystemExit):
        main(["localize", "--help"])
    assert "130  interrupted" in stdout.getvalue()


def test_ctrl_c_keeps_what_was_located(
    mapped_room: MappedRoom, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    class Interrupting(io.StringIO):
        """Standard input that is interrupted after two paths."""

        def __iter__(self) -> Interrupting:
            self.count = 0
            return self

        def __next__(self) -> str:
            self.count += 1
            if self.count > 2:
                raise KeyboardInterrupt
            return f"{mapped_room.images[self.count]}\n"

    monkeypatch.setattr("sys.stdin", Interrupting())
    options = "--out", tmp_path / "a.csv", "--draw", tmp_path / "a.png"
    localize(mapped_room.checkpoint, "-", *options, expected=130)
    assert "interrupted; 2 of 2 images located" in capsys.readouterr().err
    assert len((tmp_path / "a.csv").read_text().splitlines()) == 3
    assert (tmp_path / "a.png").is_file()
