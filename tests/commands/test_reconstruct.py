"""The command `reconstruct`: frames of a rendered room become a scene in metres, and mistakes one line."""

from __future__ import annotations

import importlib.util
import json
import re
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from lightning_pose.__main__ import main
from lightning_pose.scenes.formats import load_scene
from lightning_pose.scenes.images import read_rgb
from lightning_pose.scenes.scene import Frame, Scene
from lightning_pose.scenes.synthetic import render_room


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    """Frames along one walk, and their poses."""
    root = tmp_path_factory.mktemp("rooms") / "room"
    render_room(root, 0, 30, (320, 240))
    return load_scene(root)


@pytest.fixture(scope="module")
def truth(room: Scene) -> dict[str, Frame]:
    """Every other frame of two walks, by the name of its photo."""
    chosen = [frame for frame in room.frames if frame.sequence != room.frames[-1].sequence][::2]
    return {f"{i}.png": frame for i, frame in enumerate(chosen)}


@pytest.fixture(scope="module")
def photos(truth: dict[str, Frame], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The photos, in a folder of their own."""
    folder = tmp_path_factory.mktemp("photos")
    for name, frame in truth.items():
        shutil.copy(frame.image, folder / name)
    return folder


@pytest.fixture(scope="module")
def out(truth: dict[str, Frame], photos: Path) -> Path:
    """A scene with known positions."""
    known = photos.parent / "known.csv"
    rows = [",".join(map(str, (name, *frame.position_m))) for name, frame in truth.items()]
    known.write_text("\n".join(["image,tx,ty,tz", *rows]))
    assert main(["reconstruct", str(photos), str(photos.parent / "out"), "--align", str(known)]) == 0
    return photos.parent / "out"


def test_poses_are_those_of_the_room(out: Path, truth: dict[str, Frame]) -> None:
    found = load_scene(out, val_fraction=0, test_fraction=0)
    assert (found.format, found.unit, len(found.frames)) == ("colmap", "m", len(truth))
    error = [np.linalg.norm(f.position_m - truth[f.image.name].position_m) for f in found.frames]
    turned = [abs(float(f.quat_wxyz @ truth[f.image.name].quat_wxyz)) for f in found.frames]
    assert np.median(error) < 0.02
    assert np.degrees(2 * np.arccos(min(np.median(turned), 1))) < 1


def test_the_summary_is_kept(out: Path) -> None:
    summary = json.loads((out / "reconstruction.json").read_text())
    assert (summary["unit"], summary["posed"], summary["frames"]) == ("m", 10, 10)
    assert len(summary["residuals_m"]) == 10
    assert {"finding keypoints", "matching pairs"} <= set(summary["seconds"])
    assert summary["points"] > 100


def test_a_second_call_goes_on_and_finds_the_same(out: Path, photos: Path, capsys: pytest.CaptureFixture[str]) -> None:
    first = load_scene(out, val_fraction=0, test_fraction=0)
    assert main(["reconstruct", str(photos), str(out), "--align", str(photos.parent / "known.csv")]) == 0
    assert f"going on with what {out / 'reconstruction'} has" in capsys.readouterr().out
    steps = set(json.loads((out / "reconstruction.json").read_text())["seconds"])
    assert not {"finding keypoints", "matching pairs", "finding poses (incremental mapper)"} & steps
    again = load_scene(out, val_fraction=0, test_fraction=0)
    for one, other in zip(first.frames, again.frames, strict=True):
        np.testing.assert_allclose(one.position_m, other.position_m, atol=1e-6)


def refuse(capsys: pytest.CaptureFixture[str], *args: object) -> str:
    """The one line with which a command is refused."""
    assert main(["reconstruct", *map(str, args)]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    return line.removeprefix("error: ")


@pytest.mark.parametrize(
    ("options", "says"),
    [
        (["--every", "0"], "'0' is no number of frames; give 1 or more"),
        (["--camera", "LENS,1"], "'LENS' is no camera model"),
        (
            ["--camera", "PINHOLE,640,360,500,500,320,180"],
            r"has 320x240 pixels, .* 640x360: .* give --camera",
        ),
        (["--scale", "1 2"], "--scale is '1 2'; give two frames"),
        (["--scale", "1 2 3", "--align", "x.csv"], "not allowed with"),
        (["--align", "nowhere.csv"], "nowhere.csv is missing"),
    ],
)
def test_mistakes_in_options(
    options: list[str], says: str, photos: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert re.search(says, refuse(capsys, photos, tmp_path / "out", *options))


def test_mistakes_in_what_is_given(photos: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert "nothing.mp4 does not exist" in refuse(capsys, tmp_path / "nothing.mp4", tmp_path / "out")
    (tmp_path / "notes.txt").touch()
    assert "was not written by `reconstruct`" in refuse(capsys, photos, tmp_path)
    still = tmp_path / "still"
    still.mkdir()
    for i in range(5):
        shutil.copy(photos / "0.png", still / f"{i}.png")
    assert "still has 1 frames that differ; give 3 or more" in refuse(capsys, still, tmp_path / "out")


def test_frames_of_several_places_have_no_poses(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rng = np.random.default_rng(0)
    photos = tmp_path / "photos"
    photos.mkdir()
    for i in range(4):
        noise = cv2.resize(rng.integers(0, 255, (30, 40), np.uint8), (320, 240), interpolation=cv2.INTER_CUBIC)
        cv2.imwrite(str(photos / f"{i}.png"), noise)
    line = refuse(capsys, photos, tmp_path / "out")
    assert line.startswith(f"no poses were found for the 4 frames of {photos}: too few matches: 4 frames share 15")


def test_a_camera_that_only_turns_is_refused(tmp_path: Path, photos: Path, capsys: pytest.CaptureFixture[str]) -> None:
    photo = cv2.resize(read_rgb(photos / "0.png"), None, fx=3, fy=3, interpolation=cv2.INTER_CUBIC)
    before, after = np.diag([800.0, 800, 1]), np.diag([300.0, 300, 1])
    before[:2, 2], after[:2, 2] = (480, 360), (160, 120)
    (tmp_path / "photos").mkdir()
    for i in range(6):
        turn = Rotation.from_euler("yx", [4 * i - 10, 2 * np.sin(i)], degrees=True).as_matrix()
        view = cv2.warpPerspective(photo, after @ turn @ np.linalg.inv(before), (320, 240))
        cv2.imwrite(str(tmp_path / "photos" / f"{i}.png"), view)
    line = refuse(capsys, tmp_path / "photos", tmp_path / "out")
    assert "too little parallax" in line
    assert "move sideways while you film" in line


def test_without_pycolmap_the_remedy_is_named(
    photos: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    assert 'pip install "lightning-camera-localization[reconstruct]"' in refuse(capsys, photos, tmp_path / "out")


def test_a_distance_can_be_given_later(
    out: Path, photos: Path, truth: dict[str, Frame], capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["reconstruct", str(photos), str(out), "--scale", "0 9.png 1"]) == 0
    assert "going on" in capsys.readouterr().out
    scene = load_scene(out, val_fraction=0, test_fraction=0)
    position = {frame.image.name: frame.position_m for frame in scene.frames}
    assert np.linalg.norm(position["0.png"] - position["9.png"]) == pytest.approx(1)
    assert scene.unit == "m"
