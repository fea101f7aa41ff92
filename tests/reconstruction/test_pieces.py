"""Pieces of a scene are joined by the points that both have, or left apart where they share none."""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path

import numpy as np
import pycolmap
import pytest

from lightning_pose.geometry.similarity import Similarity
from lightning_pose.reconstruction.agreement import MatchedPair
from lightning_pose.reconstruction.pieces import find_shared_points, join_pieces, polish
from tests.reconstruction.helpers import make_model


def cut(model: pycolmap.Reconstruction, numbers: Collection[int]) -> pycolmap.Reconstruction:
    """A copy that has poses of these images only."""
    piece = pycolmap.Reconstruction(model)
    for number in sorted(set(piece.reg_image_ids()) - set(numbers)):
        piece.deregister_frame(piece.image(number).frame_id)
    return piece


def move(piece: pycolmap.Reconstruction) -> pycolmap.Reconstruction:
    """The same piece in another world."""
    piece.transform(pycolmap.Sim3d(3.0, pycolmap.Rotation3d([0.5, -1.0, 0.2]), [4.0, -5.0, 6.0]))
    return piece


def centres(model: pycolmap.Reconstruction) -> np.ndarray:
    return np.array([model.image(number).projection_center() for number in sorted(model.reg_image_ids())])


@pytest.fixture
def scene(tmp_path: Path) -> tuple[pycolmap.Reconstruction, list[MatchedPair]]:
    return make_model(tmp_path)


@pytest.mark.parametrize("second", [(5, 6, 7, 8), (3, 4, 5, 6, 7, 8)], ids=["by matches", "by shared frames"])
def test_pieces_that_meet_are_joined(
    second: tuple[int, ...], scene: tuple[pycolmap.Reconstruction, list[MatchedPair]], tmp_path: Path
) -> None:
    model, pairs = scene
    base, piece = cut(model, (1, 2, 3, 4)), move(cut(model, second))
    pairs = pairs if second[0] == 5 else []
    (joined,) = join_pieces([base, piece], pairs)
    assert joined.num_reg_images() == 8
    np.testing.assert_allclose(centres(joined), centres(model), atol=1e-6)
    polish(joined, tmp_path / "database.db", tmp_path / "polished", threads=1, fixed=True)
    found = Similarity.fit(centres(joined), centres(model))
    assert found is not None
    np.testing.assert_allclose(found.apply(centres(joined)), centres(model), atol=1e-3)
    assert joined.num_points3D() > 0.9 * model.num_points3D()


def test_a_piece_that_meets_a_joined_one_is_joined(
    scene: tuple[pycolmap.Reconstruction, list[MatchedPair]],
) -> None:
    model, pairs = scene
    chain = [pair for pair in pairs if not ({1, 2, 3} & set(pair[:2]) and {7, 8} & set(pair[:2]))]
    pieces = [cut(model, (1, 2, 3)), move(cut(model, (4, 5, 6))), move(cut(model, (7, 8)))]
    (joined,) = join_pieces(pieces, chain)
    np.testing.assert_allclose(centres(joined), centres(model), atol=1e-6)


def test_pieces_without_matches_stay_apart(scene: tuple[pycolmap.Reconstruction, list[MatchedPair]]) -> None:
    model, _ = scene
    base, piece = cut(model, (1, 2, 3, 4, 5)), move(cut(model, (6, 7, 8)))
    left = join_pieces([base, piece], [])
    assert [each.num_reg_images() for each in left] == [5, 3]


def test_wrong_matches_join_nothing(scene: tuple[pycolmap.Reconstruction, list[MatchedPair]]) -> None:
    model, pairs = scene
    rng = np.random.default_rng(0)
    wrong = [(a, b, np.column_stack([rows[:, 0], rng.permutation(rows[:, 1])])) for a, b, rows in pairs]
    base, piece = cut(model, (1, 2, 3, 4)), move(cut(model, (5, 6, 7, 8)))
    assert len(find_shared_points(base, piece, wrong).base) > 100
    assert len(join_pieces([base, piece], wrong)) == 2
