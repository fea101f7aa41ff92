"""How many matches a model explains: all where it is right, and few where a camera is elsewhere."""

from __future__ import annotations

from pathlib import Path

import pycolmap

from lightning_pose.reconstruction.agreement import count_agreeing, drop_poor_frames
from tests.reconstruction.helpers import make_model


def test_a_right_model_explains_all_matches(tmp_path: Path) -> None:
    model, pairs = make_model(tmp_path)
    total = sum(len(rows) for *_, rows in pairs)
    assert total > 1000
    assert count_agreeing(model, pairs) == total


def test_a_wrong_pose_and_a_missing_one_explain_nothing_of_their_frame(tmp_path: Path) -> None:
    model, pairs = make_model(tmp_path)
    others = sum(len(rows) for a, b, rows in pairs if 1 not in (a, b))
    frame = model.frame(model.image(1).frame_id)
    turn = pycolmap.Rigid3d(pycolmap.Rotation3d([0.0, 0.0, 0.5]), [0.5, 0.0, 0.0])
    frame.rig_from_world = turn * model.image(1).cam_from_world()
    assert others <= count_agreeing(model, pairs) < others + 0.2 * (sum(len(rows) for *_, rows in pairs) - others)
    model.deregister_frame(frame.frame_id)
    assert count_agreeing(model, pairs) == others


def test_a_frame_at_a_wrong_place_loses_its_pose(tmp_path: Path) -> None:
    model, pairs = make_model(tmp_path)
    assert drop_poor_frames(model, pairs) == []
    turn = pycolmap.Rigid3d(pycolmap.Rotation3d([0.0, 0.0, 0.5]), [0.5, 0.0, 0.0])
    model.frame(model.image(3).frame_id).rig_from_world = turn * model.image(3).cam_from_world()
    assert drop_poor_frames(model, pairs) == [3]
    assert 3 not in model.reg_image_ids()


def test_a_frame_without_points_loses_its_pose(tmp_path: Path) -> None:
    model, pairs = make_model(tmp_path)
    for i, point in enumerate(model.image(2).points2D):
        if point.has_point3D():
            model.delete_observation(2, i)
    assert drop_poor_frames(model, pairs) == [2]
