"""A synthetic room on disk: layout, poses, determinism, resuming, and what it refuses."""

from __future__ import annotations

import functools
import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest

from lightning_pose.errors import ConfigError, DataError
from lightning_pose.scenes.formats import load_scene
from lightning_pose.scenes.synthetic import dataset, render_room
from lightning_pose.scenes.synthetic.dataset import divide_frames
from lightning_pose.scenes.synthetic.trajectory import is_test, make_walks

FRAMES, SIZE = 13, (64, 48)
ROOMS = functools.cache(dataset.make_room)


def contents(root: Path) -> dict[str, bytes]:
    return {str(path.relative_to(root)): path.read_bytes() for path in root.rglob("*") if path.is_file()}


@pytest.fixture
def built_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """Spare the tests that are not about the room itself the building of it."""
    monkeypatch.setattr(dataset, "make_room", ROOMS)


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return render_room(tmp_path_factory.mktemp("rooms") / "room", 0, FRAMES, SIZE)


def test_layout_is_that_of_7_scenes(room: Path) -> None:
    assert (room / "TrainSplit.txt").read_text() == "sequence1\nsequence2\n"
    assert (room / "TestSplit.txt").read_text() == "sequence3\n"
    assert [len(list((room / f"seq-{i:02d}").glob("*.color.png"))) for i in (1, 2, 3)] == [5, 4, 4]
    image = cv2.imread(str(room / "seq-01" / "frame-000004.color.png"))
    assert image is not None
    assert image.shape == (48, 64, 3)
    assert image.std() > 20
    written = json.loads((room / "synthetic.json").read_text())
    assert (written["seed"], written["frames"], written["size"]) == (0, FRAMES, [64, 48])
    assert written["intrinsics"] == {"fx": 52.5, "fy": 52.5, "cx": 31.5, "cy": 23.5}


def test_poses_are_rigid_and_inside_the_room(room: Path) -> None:
    for path in room.rglob("*.pose.txt"):
        pose = np.loadtxt(path)
        assert np.allclose(pose[:3, :3].T @ pose[:3, :3], np.eye(3), atol=1e-7)
        assert np.linalg.det(pose[:3, :3]) == pytest.approx(1)
        assert (pose[3] == (0, 0, 0, 1)).all()
        assert (np.abs(pose[:2, 3]) < (1.6, 1.9)).all()
        assert 1.0 < pose[2, 3] < 1.8
        assert pose[1, 2] > 0.3, "looks towards +y"
        assert pose[2, 1] < -0.9, "the image's down is the world's down"


def test_same_seed_same_bytes_on_one_thread_or_many(
    room: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(dataset.os, "cpu_count", lambda: 1)
    assert contents(render_room(tmp_path / "again", 0, FRAMES, SIZE)) == contents(room)


def test_another_seed_is_another_room(room: Path, tmp_path: Path) -> None:
    other = contents(render_room(tmp_path / "other", 1, FRAMES, SIZE))
    same = [name for name, data in contents(room).items() if other.get(name) == data]
    assert sorted(same) == ["TestSplit.txt", "TrainSplit.txt"]


def test_an_equal_room_is_kept(room: Path) -> None:
    before = (room / "seq-01" / "frame-000000.color.png").stat().st_mtime_ns
    calls: list[int] = []
    assert render_room(room, 0, FRAMES, SIZE, lambda done, total: calls.append(done)) == room
    assert not calls
    assert (room / "seq-01" / "frame-000000.color.png").stat().st_mtime_ns == before


@pytest.mark.usefixtures("built_once")
def test_each_session_is_a_sequence_and_the_last_one_tests(tmp_path: Path) -> None:
    root = render_room(tmp_path / "room", 0, 7, (64, 48), sessions=2)
    scene = load_scene(root, val_fraction=0)
    assert [frame.sequence for frame in scene.frames] == ["seq-01"] * 4 + ["seq-02"] * 3
    assert [scene.splits[split].tolist() for split in ("train", "test")] == [[0, 1, 2, 3], [4, 5, 6]]
    other = load_scene(root, val_fraction=0, split="folders:seq-01")
    assert other.splits["test"].tolist() == [0, 1, 2, 3]
    first, last = (
        np.array([f.position_m for f in scene.frames if f.sequence == name]) for name in ("seq-01", "seq-02")
    )
    assert np.linalg.norm(first[:, None] - last, axis=-1).min() > 0.05, "walks of their own"
    tints = [np.asarray(cv2.imread(str(scene.frames[i].image))).mean((0, 1)) for i in (0, 4)]
    assert np.abs(tints[0] / tints[1] - 1).max() > 0.05


def test_something_else_is_never_overwritten(room: Path, tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"room already holds another synthetic room \(seed 0\); .*delete it first"):
        render_room(room, 7, FRAMES, SIZE)
    (tmp_path / "photo.jpg").write_bytes(b"mine")
    with pytest.raises(DataError, match="not a synthetic room; give another folder"):
        render_room(tmp_path, 0, FRAMES, SIZE)
    with pytest.raises(DataError, match=r"photo\.jpg already holds something"):
        render_room(tmp_path / "photo.jpg", 0, FRAMES, SIZE)
    with pytest.raises(DataError, match=r"cannot write the room to .*give a folder that can be written"):
        render_room(tmp_path / "photo.jpg" / "room", 0, FRAMES, SIZE)


@pytest.mark.usefixtures("built_once")
def test_an_interrupted_render_leaves_nothing(tmp_path: Path) -> None:
    def stop(done: int, total: int) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        render_room(tmp_path / "room", 0, FRAMES, SIZE, stop)
    assert not list(tmp_path.iterdir())


@pytest.mark.usefixtures("built_once")
def test_another_process_that_finishes_first_wins(room: Path, tmp_path: Path) -> None:
    root = tmp_path / "room"

    def race(done: int, total: int) -> None:
        if done == total:
            shutil.copytree(room, root)

    assert render_room(root, 0, FRAMES, SIZE, race) == root
    assert contents(root) == contents(room)
    assert [path.name for path in tmp_path.iterdir()] == ["room"]


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"seed": -1}, "seed is -1; give a whole number"),
        ({"frames": 5}, "frames is 5, .*give 6 or more"),
        ({"size": (32, 240)}, "size is 32x240; give .*64x48 to 1920x1440"),
        ({"size": (4000, 3000)}, "size is 4000x3000; give .*64x48 to 1920x1440"),
    ],
)
def test_bad_values_are_named_with_their_remedy(tmp_path: Path, wrong: dict, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        render_room(tmp_path / "room", **wrong)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("frames", "count", "longest"), [(6, 3, 2), (150, 5, 30), (300, 10, 30), (1000, 10, 100), (2350, 24, 98)]
)
def test_sequences_are_few_and_at_most_100_frames(frames: int, count: int, longest: int) -> None:
    lengths = divide_frames(frames)
    assert (sum(lengths), len(lengths), max(lengths)) == (frames, count, longest)


@pytest.mark.parametrize("seed", range(4))
def test_test_walks_pass_near_training_walks_and_steps_are_small(seed: int) -> None:
    lengths = divide_frames(300)
    walks = make_walks(seed, np.array([6.0, 4.1, 2.7]), lengths)
    poses = [np.array([walk.pose(frame) for frame in range(walk.length)]) for walk in walks]
    train = np.concatenate([p for i, p in enumerate(poses) if not is_test(i)])[:, :3, 3]
    test = np.concatenate([p for i, p in enumerate(poses) if is_test(i)])[:, :3, 3]
    assert (len(train), len(test)) == (240, 60)
    oracle = np.median(np.linalg.norm(test[:, None] - train, axis=-1).min(1))
    mean = np.median(np.linalg.norm(test - train.mean(0), axis=-1))
    assert 0.05 < oracle < mean / 3
    for sequence in poses:
        assert np.linalg.norm(np.diff(sequence[:, :3, 3], axis=0), axis=1).max() < 0.07
        turns = np.einsum("nij,nij->n", sequence[:-1, :3, :3], sequence[1:, :3, :3])
        assert np.degrees(np.arccos(np.clip((turns - 1) / 2, -1, 1))).max() < 4
