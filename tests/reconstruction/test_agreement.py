"""How many matches a model explains: all where it is right, and few where a camera is elsewhere."""

from __future__ import annotations

from pathlib import Path

import pycolmap

from lightning_pose.reconstruction.agreement import count_agreeing
from tests.reconstruction.helpers import make_model


def test_a_right_model_explains_all_matches(tmp_path: Path) -> None:
    model, pairs = make_model(tmp_path)
    total = sum(len(rows) for *_, rows in pairs)
    assert total > 1000
    assert count_agreeing(model, pairs) == total


def test_a_wrong_pose_and_a_missing_one_explain_nothing_of_their_frame(tmp_path: Path) -> None:
    model, pairs = make_model(tmp_path)
    others = sum(len(rows) for a, b, rows in pairs if 1 not in (a, b))
    frame = model.image(1).frame
    turn = pycolmap.Rigid3d(pycolmap.Rotation3d([0.0, 0.0, 0.5]), [0.5, 0.0, 0.0])
    assert frame is not None
    assert frame.rig_from_world is not None
    frame.rig_from_world = turn * frame.rig_from_world
    assert others <= count_agreeing(model, pairs) < others + 0.2 * (sum(len(rows) for *_, rows in pairs) - others)
    model.deregister_frame(frame.frame_id)
    assert count_agreeing(model, pairs) == others
