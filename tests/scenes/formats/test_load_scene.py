"""Recognising a folder's format, and finding formats."""

from __future__ import annotations

from pathlib import Path

import pytest

from lightning_pose.errors import ConfigError, DataError
from lightning_pose.scenes import formats
from lightning_pose.scenes.formats import known_formats, load_scene
from tests.data.helpers import write_seven_scenes

ONE_FILE = """
from lightning_pose.scenes.formats.base import SceneFormat

class Added(SceneFormat):
    name = "added"
    looks_for = "added.txt"
    def matches(self, root):
        return (root / "added.txt").is_file()
    def read(self, root):
        raise NotImplementedError("read was asked")

FORMAT = Added()
"""


def test_formats() -> None:
    assert {"12scenes", "7scenes", "cambridge", "icl_nuim", "tum"} <= known_formats().keys()


def test_a_format_is_one_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "added_format.py").write_text(ONE_FILE)
    (tmp_path / "added.txt").touch()
    monkeypatch.setattr(formats, "__path__", [*formats.__path__, str(tmp_path)])
    with pytest.raises(NotImplementedError, match="read was asked"):
        load_scene(tmp_path)


def test_unknown_format_lists_the_known(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"'nuscenes' is unknown; the formats are 12scenes, 7scenes, ace, "):
        load_scene(tmp_path, format="nuscenes")


def test_missing_folder(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"nowhere is not a folder; give"):
        load_scene(tmp_path / "nowhere")


def test_no_dataset_lists_the_files_that_were_looked_for(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"7scenes: TrainSplit.txt and TestSplit.txt, .* force a format") as caught:
        load_scene(str(tmp_path))
    assert str(tmp_path) in str(caught.value)


def test_parent_folder_names_the_datasets_inside(tmp_path: Path) -> None:
    for name in ("chess", "fire"):
        write_seven_scenes(tmp_path / name, train={1: 2}, test={2: 1})
    (tmp_path / "notes").mkdir()
    with pytest.raises(DataError, match=r"holds chess, fire; give one of these"):
        load_scene(tmp_path)


def test_of_two_formats_in_one_folder_one_must_be_given(tmp_path: Path) -> None:
    write_seven_scenes(tmp_path, train={1: 4}, test={2: 1})
    for name in ("dataset_train.txt", "dataset_test.txt"):
        (tmp_path / name).touch()
    with pytest.raises(DataError, match=r"may be cambridge or 7scenes; give one of them as `format`"):
        load_scene(tmp_path)
    assert load_scene(tmp_path, format="7scenes").format == "7scenes"
