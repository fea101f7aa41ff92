"""Damaged datasets of every format: a scene whose poses are numbers, or one line that says what is wrong."""

from __future__ import annotations

import logging
import tempfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lightning_pose.errors import PoseError
from lightning_pose.scenes.formats import load_scene
from tests.fuzz.datasets import DATASETS, Damage, apply_damages, damages, write_files

LONGEST_ERROR = 4000


@pytest.fixture(autouse=True)
def _no_warnings() -> Iterator[None]:
    logging.disable(logging.WARNING)
    yield
    logging.disable(logging.NOTSET)


@pytest.mark.parametrize("name", DATASETS)
def test_undamaged_dataset_is_read(name: str, tmp_path: Path) -> None:
    assert len(load_scene(write_files(tmp_path / "scene", DATASETS[name]), val_fraction=0).frames) >= 6


@pytest.mark.parametrize("name", DATASETS)
@given(chosen=damages, drop=st.booleans())
def test_damaged_dataset_is_read_or_refused_in_one_line(name: str, chosen: list[Damage], drop: bool) -> None:
    with tempfile.TemporaryDirectory() as folder:
        root = write_files(Path(folder) / "scene", apply_damages(DATASETS[name], chosen))
        try:
            scene = load_scene(root, on_bad_frame="drop" if drop else "refuse")
        except PoseError as error:
            message = str(error)
        else:
            message = ""
    if message:
        assert "\n" not in message
        assert len(message) < LONGEST_ERROR
        return
    for frame in scene.frames:
        assert np.isfinite(frame.position_m).all()
        assert abs(np.linalg.norm(frame.quat_wxyz) - 1) < 1e-6
    used = np.concatenate([scene.splits[split] for split in ("train", "val", "test")])
    assert len(set(used.tolist())) == len(used)
