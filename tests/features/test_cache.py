"""Tests of the feature cache: each image is extracted once, also after errors, kills and damage."""

from __future__ import annotations

import json
import logging
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from lightning_pose.errors import CacheError, ConfigError, ImageError
from lightning_pose.features import fill_job
from lightning_pose.features.base import Record
from lightning_pose.features.cache import FeatureCache
from lightning_pose.features.opencv import BRIEF
from lightning_pose.features.record_files import read_record
from tests.features.helpers import ColorMeans, expected, records_in, write_images

REPOSITORY = Path(__file__).parents[2]
FILL_SLOWLY = """
import sys
from pathlib import Path
from lightning_pose.features.cache import FeatureCache
from tests.features.helpers import ColorMeans
print("ready", flush=True)
sys.stdin.readline()
images, root = map(Path, sys.argv[1:])
print(FeatureCache(ColorMeans(seconds=0.05), root).fill(sorted(images.iterdir()), 2, progress=False))
"""


def start_filling(images: Path, root: Path) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, "-c", FILL_SLOWLY, str(images), str(root)],
        cwd=REPOSITORY,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )


def start_fill(process: subprocess.Popen[str]) -> None:
    assert process.stdin is not None
    assert process.stdout is not None
    assert process.stdout.readline() == "ready\n"
    process.stdin.write("\n")
    process.stdin.flush()


def test_features_in_order(tmp_path: Path) -> None:
    paths = write_images(tmp_path / "images", 30)
    cache = FeatureCache(ColorMeans(), tmp_path / "cache")
    features = cache.features(paths[::-1], progress=False)
    assert features.dtype == np.float32
    np.testing.assert_array_equal(features, expected(30)[::-1])
    np.testing.assert_array_equal(cache.features(paths[3:5], progress=False), expected(30)[3:5])


def test_second_run_computes_nothing(tmp_path: Path) -> None:
    paths = write_images(tmp_path / "images", 10)
    first = FeatureCache(ColorMeans(), tmp_path / "cache").fill(paths, progress=False)
    assert (first.total, first.computed, first.cached, first.redone) == (10, 10, 0, 0)
    assert first.seconds_per_image > 0

    moved = Path(shutil.move(tmp_path / "images", tmp_path / "elsewhere"))
    again = ColorMeans()
    second = FeatureCache(again, tmp_path / "cache").fill(sorted(moved.iterdir()), progress=False)
    assert (second.computed, second.cached, second.seconds_per_image) == (0, 10, 0.0)
    assert again.seen == []


def test_no_images(tmp_path: Path) -> None:
    cache = FeatureCache(ColorMeans(), tmp_path / "cache")
    assert cache.features([]).shape == (0, 3)
    assert list(cache.records([])) == []
    assert not (tmp_path / "cache").exists()


def test_equal_images_are_extracted_once(tmp_path: Path) -> None:
    paths = write_images(tmp_path, 3)
    copy = Path(shutil.copy(paths[1], tmp_path / "copy.png"))
    cache = FeatureCache(extractor := ColorMeans(), tmp_path / "cache")
    np.testing.assert_array_equal(
        cache.features([*paths, copy, paths[1]], progress=False), expected(3)[[0, 1, 2, 1, 1]]
    )
    assert sum(extractor.seen) == 3
    assert cache.fill([*paths, copy], progress=False).cached == 4


def test_settings_have_their_own_folder(tmp_path: Path) -> None:
    paths = write_images(tmp_path / "images", 2)
    one, two = (FeatureCache(ColorMeans(scale), tmp_path / "cache") for scale in (1.0, 2.0))
    np.testing.assert_array_equal(one.features(paths) * 2, two.features(paths))
    assert one.folder != two.folder
    assert one.folder.name.startswith("colormeans-")
    about = json.loads((two.folder / "settings.json").read_text())
    assert about["name"] == "colormeans"
    assert about["settings"] == {"scale": 2.0}


class NewColorMeans(ColorMeans):
    """The same extractor after its computation has changed."""

    version = 2
    name = "colormeans"  # pyright: ignore[reportAssignmentType]


def test_versions_have_their_own_folder(tmp_path: Path) -> None:
    old, new = (FeatureCache(extractor, tmp_path) for extractor in (ColorMeans(), NewColorMeans()))
    assert old.folder != new.folder


class Broken(ColorMeans):
    """An extractor whose network returns no numbers for images 1 and 3."""

    def extract(self, images: Sequence[np.ndarray]) -> list[Record]:
        records = super().extract(images)
        for record in records:
            if record["means"][0] in (1, 3):
                record["means"] = record["means"] * np.float32(np.nan)
        return records


def test_features_that_are_no_numbers_are_refused(tmp_path: Path) -> None:
    paths = write_images(tmp_path / "images", 4)
    cache = FeatureCache(Broken(), tmp_path / "cache")
    with pytest.raises(ImageError, match=f"2 of 4 images.*{paths[1].name}.*{paths[3].name}"):
        cache.features(paths, progress=False)
    assert np.isfinite(cache.features([paths[0], paths[2]], progress=False)).all()


def test_fewer_features_are_a_prefix_and_nothing_is_extracted(tmp_path: Path) -> None:
    path = tmp_path / "noise.png"
    cv2.imwrite(str(path), np.random.default_rng(0).integers(0, 256, (160, 200), np.uint8))
    many = FeatureCache(BRIEF(300), tmp_path / "cache").features([path])
    few = FeatureCache(BRIEF(50, with_geometry=True), tmp_path / "cache")
    assert few.fill([path]).computed == 0
    np.testing.assert_array_equal(few.features([path])[..., :256], many[:, :50])


def test_records_in_order(tmp_path: Path) -> None:
    paths = write_images(tmp_path / "images", 100)
    asked = [*range(100), *range(50)]  # more than twice as many as are in memory at a time
    records = FeatureCache(ColorMeans(), tmp_path / "cache").records([paths[i] for i in asked], progress=False)
    np.testing.assert_array_equal([r["means"] for r in records], expected(100)[asked])


@pytest.mark.parametrize(
    "damage",
    [lambda data: data[:-5], lambda data: b"", lambda data: data[:-1] + bytes([data[-1] ^ 1])],
    ids=["truncated", "empty", "flipped"],
)
@pytest.mark.parametrize("call", ["fill", "features"])
def test_damaged_file_is_reported_and_redone(
    call: str, damage: Callable[[bytes], bytes], tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    paths = write_images(tmp_path / "images", 5)
    cache = FeatureCache(extractor := ColorMeans(), tmp_path / "cache")
    cache.fill(paths, progress=False)
    victim = records_in(cache.root)[2]
    victim.write_bytes(damage(victim.read_bytes()))
    extractor.seen.clear()

    with caplog.at_level(logging.WARNING, "lightning_pose"):
        result = getattr(cache, call)(paths, progress=False)
    assert f"{victim} is damaged" in caplog.text
    assert extractor.seen == [1]
    if call == "fill":
        assert (result.computed, result.cached, result.redone) == (0, 4, 1)
    np.testing.assert_array_equal(cache.features(paths, progress=False), expected(5))
    assert extractor.seen == [1]


def test_bad_images_do_not_stop_the_others(tmp_path: Path) -> None:
    paths = write_images(tmp_path / "images", 20)
    paths[3].write_bytes(b"not an image")
    paths[7].unlink()
    cache = FeatureCache(ColorMeans(), tmp_path / "cache")
    with pytest.raises(ImageError, match=r"2 of 20 images cannot be read: .*00[37]\.png.*00[37]\.png"):
        cache.fill(paths, progress=False)
    assert len(records_in(cache.root)) == 18
    good = [path for number, path in enumerate(paths) if number not in (3, 7)]
    assert cache.fill(good, progress=False).cached == 18


def test_many_bad_images_are_counted(tmp_path: Path) -> None:
    with pytest.raises(ImageError, match=r"^9 of 9 images.*0\.png.*1\.png.*2\.png.*; \.\.\.$"):
        FeatureCache(ColorMeans(), tmp_path).fill([tmp_path / f"{n}.png" for n in range(9)])


def test_one_bad_image_gives_its_own_error(tmp_path: Path) -> None:
    with pytest.raises(ImageError, match=r"^.*gone\.png does not exist; check the path"):
        FeatureCache(ColorMeans(), tmp_path).features([tmp_path / "gone.png"])


def test_image_that_changes_meanwhile_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    first, second = write_images(tmp_path / "images", 2)
    contents = iter([first.read_bytes(), second.read_bytes()])
    monkeypatch.setattr(fill_job, "read_bytes", lambda path: next(contents))
    cache = FeatureCache(ColorMeans(), tmp_path / "cache")
    with pytest.raises(ImageError, match=r"000\.png changed while it was read; run again"):
        cache.fill([first], progress=False)
    assert records_in(cache.root) == []


def test_resumes_after_a_kill(tmp_path: Path) -> None:
    paths = write_images(tmp_path / "images", 100)
    root = tmp_path / "cache"
    with start_filling(tmp_path / "images", root) as process:
        start_fill(process)
        while len(records_in(root)) < 20:
            assert process.poll() is None
            time.sleep(0.005)
        process.kill()
    saved = records_in(root)
    assert 20 <= len(saved) < 100
    assert all(read_record(file) for file in saved)  # none is cut short

    cache = FeatureCache(ColorMeans(), root)
    report = cache.fill(paths, progress=False)
    assert (report.computed, report.cached, report.redone) == (100 - len(saved), len(saved), 0)
    np.testing.assert_array_equal(cache.features(paths, progress=False), expected(100))


def test_two_processes_at_once(tmp_path: Path) -> None:
    paths = write_images(tmp_path / "images", 60)
    cache = FeatureCache(extractor := ColorMeans(seconds=0.02), tmp_path / "cache")
    with start_filling(tmp_path / "images", cache.root) as other:
        start_fill(other)
        np.testing.assert_array_equal(cache.features(paths, workers=2, progress=False), expected(60))
        report, _ = other.communicate(timeout=60)
    assert other.returncode == 0
    assert "total=60" in report
    assert "redone=0" in report
    extractor.seen.clear()
    np.testing.assert_array_equal(cache.features(paths), expected(60))
    assert extractor.seen == []
    assert list(cache.root.rglob("*.tmp")) == []


def test_only_old_temporary_files_are_cleared(tmp_path: Path) -> None:
    (path,) = write_images(tmp_path / "images", 1)
    cache = FeatureCache(ColorMeans(), tmp_path / "cache")
    old, young = cache.folder / "ab" / "old.tmp", cache.folder / "ab" / "young.tmp"
    old.parent.mkdir(parents=True)
    old.touch()
    young.touch()
    os.utime(old, (0, 0))
    cache.fill([path], progress=False)
    assert [old.exists(), young.exists()] == [False, True]


def test_root_that_cannot_be_written(tmp_path: Path) -> None:
    (path,) = write_images(tmp_path / "images", 1)
    root = tmp_path / "file"
    root.touch()
    with pytest.raises(CacheError, match=r"cannot write to the feature cache in .*file.*LIGHTNING_POSE_CACHE"):
        FeatureCache(extractor := ColorMeans(), root).fill([path], progress=False)
    assert extractor.seen == []


def test_extractor_error_passes_through(tmp_path: Path) -> None:
    class Broken(ColorMeans):
        def extract(self, images: Sequence[np.ndarray]) -> list[Record]:
            raise ZeroDivisionError("a bug")

    before = torch.get_num_threads(), cv2.getNumThreads()
    with pytest.raises(ZeroDivisionError, match="a bug"):
        FeatureCache(Broken(), tmp_path / "cache").fill(write_images(tmp_path, 20), progress=False)
    assert (torch.get_num_threads(), cv2.getNumThreads()) == before


@pytest.mark.parametrize("workers", [4, None], ids=["given", "as many as cores"])
def test_no_more_threads_than_workers(workers: int | None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "sched_getaffinity", lambda process: set(range(4)), raising=False)
    inside: list[int] = []

    class Curious(ColorMeans):
        def extract(self, images: Sequence[np.ndarray]) -> list[Record]:
            inside.append(torch.get_num_threads())
            return super().extract(images)

    extractor = Curious()
    cache = FeatureCache(extractor, tmp_path / "cache")
    paths = write_images(tmp_path / "images", 40)
    cache.fill(paths[:1], workers, progress=False)
    assert inside == [4]
    inside.clear()
    cache.fill(paths, workers, progress=False)
    assert set(inside) == {1}
    assert max(extractor.seen) <= 8


def test_workers_must_be_positive(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="workers is 0; give"):
        FeatureCache(ColorMeans(), tmp_path).fill([], workers=0)


def test_default_root(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("LIGHTNING_POSE_CACHE", str(tmp_path))
    assert FeatureCache(ColorMeans()).root == tmp_path / "features"
    monkeypatch.delenv("LIGHTNING_POSE_CACHE")
    assert FeatureCache(ColorMeans()).root.parts[-2:] == ("lightning_pose", "features")


def test_progress_goes_to_stderr(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    FeatureCache(ColorMeans(), tmp_path / "cache").fill(write_images(tmp_path, 4))
    out, err = capsys.readouterr()
    assert out == ""
    assert "colormeans" in err


def test_a_record_put_in_another_image_s_place_is_extracted_again(tmp_path: Path) -> None:
    paths = write_images(tmp_path / "images", 2)
    cache = FeatureCache(ColorMeans(), tmp_path / "cache")
    cache.fill(paths, progress=False)
    first, second = records_in(tmp_path / "cache")
    second.write_bytes(first.read_bytes())
    assert cache.fill(paths, progress=False).redone == 1
    np.testing.assert_array_equal(cache.features(paths, progress=False), expected(2))
    assert cache.fill(paths, progress=False).redone == 0
