"""The folder of a reconstruction: it is gone on with, or made anew, and never that of something else."""

from __future__ import annotations

from pathlib import Path

import pytest

from lightning_pose.errors import DataError
from lightning_pose.reconstruction.workspace import open_workspace

SETTINGS = {"source": [["a.mp4", 5, 7]], "every": None, "camera": None}


def test_the_same_settings_go_on(tmp_path: Path) -> None:
    root = tmp_path / "deep" / "out"
    first = open_workspace(root, SETTINGS)
    first.keep("frames", [1, 2])
    assert first.changed is None
    again = open_workspace(root, SETTINGS)
    assert (again.changed, again.read("frames"), again.read("nothing")) == ((), [1, 2], None)


def test_other_settings_begin_anew_and_are_named(tmp_path: Path) -> None:
    workspace = open_workspace(tmp_path, SETTINGS)
    workspace.keep("frames", [1, 2])
    workspace.images.mkdir()
    (workspace.images / "a.jpg").touch()
    again = open_workspace(tmp_path, SETTINGS | {"every": 2, "camera": "PINHOLE"})
    assert again.changed == ("camera", "every")
    assert again.read("frames") is None
    assert not again.images.exists()


def test_a_folder_of_something_else_is_refused(tmp_path: Path) -> None:
    (tmp_path / "thesis.txt").touch()
    with pytest.raises(DataError, match="was not written by `reconstruct`; give the name of a new folder"):
        open_workspace(tmp_path, SETTINGS)
    assert (tmp_path / "thesis.txt").exists()
