"""Joins models that share no frame or a few: points that both have, found through matches, give the similarity."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pycolmap

from lightning_pose.geometry.similarity import Similarity

__all__ = ["SharedPoints", "add_piece", "find_shared_points", "join_pieces", "polish"]

MIN_SHARED = 15
"""Points that must agree on how two pieces lie to each other."""

MIN_FRAMES = 2
"""Frames of the smaller piece that these points must be seen in, so that one wrong pair joins nothing."""

TOLERANCE = 0.05
"""Distance within which a point agrees, as a share of its distance from the camera that sees it."""


class SharedPoints(NamedTuple):
    """Points that two models have in common, each in its own coordinates.

    Attributes:
        base: (N, 3).
        piece: (N, 3).
        depth: (N,) distance from the camera of the base that sees it.
        frame: (N,) number of the image of the piece that sees it.
    """

    base: np.ndarray
    piece: np.ndarray
    depth: np.ndarray
    frame: np.ndarray


def find_shared_points(
    base: pycolmap.Reconstruction,
    piece: pycolmap.Reconstruction,
    pairs: Iterable[tuple[int, int, np.ndarray]],
) -> SharedPoints:
    """Points of two models that are one, by matches of an image of one with an image of the other.

    Args:
        base: the one model.
        piece: the other.
        pairs: numbers of two images, and (K, 2) rows of their keypoints that match. An image that both models have
            matches itself without being listed.
    """
    point_of_base, point_of_piece = (_list_point_numbers(model) for model in (base, piece))
    both = sorted(set(point_of_base) & set(point_of_piece))
    own = [(i, i, np.repeat(np.arange(len(point_of_base[i]))[:, None], 2, axis=1)) for i in both]
    found: dict[tuple[int, int], tuple[int, int]] = {}
    for a, b, rows in [*own, *pairs]:
        for i, j, each in ((a, b, rows), (b, a, rows[:, ::-1])):
            if i not in point_of_base or j not in point_of_piece:
                continue
            here, there = point_of_base[i][each[:, 0]], point_of_piece[j][each[:, 1]]
            for k in np.flatnonzero((here >= 0) & (there >= 0)):
                found.setdefault((int(here[k]), int(there[k])), (i, j))
    shared = [
        (base.point3D(p).xyz, piece.point3D(q).xyz, base.image(i).projection_center(), j)
        for (p, q), (i, j) in sorted(found.items())
    ]
    here, there, centre = (np.array([row[k] for row in shared]).reshape(-1, 3) for k in range(3))
    return SharedPoints(here, there, np.linalg.norm(here - centre, axis=1), np.array([row[3] for row in shared], int))


def _list_point_numbers(model: pycolmap.Reconstruction) -> dict[int, np.ndarray]:
    """By the number of each posed image: the number of each keypoint's point, -1 for none."""
    numbers = {}
    for number in model.reg_image_ids():
        points = model.image(number).points2D
        numbers[number] = np.array([point.point3D_id if point.has_point3D() else -1 for point in points], np.int64)
    return numbers


def fit_piece(shared: SharedPoints, seed: int = 0) -> Similarity | None:
    """The similarity from a piece to its base on which enough points agree; None if they do not."""
    if len(shared.base) < MIN_SHARED:
        return None
    rng = np.random.default_rng(seed)
    best = np.zeros(len(shared.base), bool)
    for _ in range(500):
        rows = rng.choice(len(shared.base), 3, replace=False)
        agree = _agree(Similarity.fit(shared.piece[rows], shared.base[rows]), shared)
        best = agree if agree.sum() > best.sum() else best
    for _ in range(3):
        if best.sum() < MIN_SHARED or len(set(shared.frame[best].tolist())) < MIN_FRAMES:
            return None
        found = Similarity.fit(shared.piece[best], shared.base[best])
        best = _agree(found, shared)
    return found


def _agree(found: Similarity | None, shared: SharedPoints) -> np.ndarray:
    """(N,) which points lie where a similarity says."""
    if found is None:
        return np.zeros(len(shared.base), bool)
    return np.linalg.norm(found.apply(shared.piece) - shared.base, axis=1) < TOLERANCE * shared.depth


def add_piece(base: pycolmap.Reconstruction, piece: pycolmap.Reconstruction, found: Similarity) -> int:
    """Give images of the base that have no pose the pose that they have in a piece; return how many.

    Points that two of these images see come along, so that a further piece can join there.
    """
    piece.transform(pycolmap.Sim3d(found.scale, pycolmap.Rotation3d(found.rotation), found.shift))
    posed = set(base.reg_image_ids())
    new = {number for number in piece.reg_image_ids() if number not in posed}
    for number in sorted(new):
        image = piece.image(number)
        if not base.exists_image(number):
            if not base.exists_camera(image.camera_id):
                base.add_camera_with_trivial_rig(piece.camera(image.camera_id))
            copy = pycolmap.Image(name=image.name, camera_id=image.camera_id, image_id=number)
            copy.points2D = pycolmap.Point2DList([pycolmap.Point2D(point.xy) for point in image.points2D])
            base.add_image_with_trivial_frame(copy, image.cam_from_world())
        else:
            frame = base.frame(base.image(number).frame_id)
            frame.rig_from_world = image.cam_from_world()
            base.register_frame(frame.frame_id)
    for point in piece.points3D.values():
        seen = [each for each in point.track.elements if each.image_id in new]
        if len(seen) > 1:
            base.add_point3D(point.xyz, pycolmap.Track(seen))
    return len(new)


def join_pieces(
    models: Sequence[pycolmap.Reconstruction], pairs: Sequence[tuple[int, int, np.ndarray]]
) -> list[pycolmap.Reconstruction]:
    """Add to the largest model the poses of each other one that lies to it in one way.

    Args:
        models: at least one, the largest first; they are changed.
        pairs: as for `find_shared_points`.

    Returns:
        the largest model, and those that did not join. A model that joins a joined one is added too.
    """
    base, *others = models
    waiting = list(others)
    while waiting:
        fits = {id(piece): fit_piece(find_shared_points(base, piece, pairs)) for piece in waiting}
        joining = [piece for piece in waiting if fits[id(piece)] is not None]
        for piece in joining:
            found = fits[id(piece)]
            assert found is not None
            add_piece(base, piece, found)
            waiting.remove(piece)
        if not joining:
            break
    return [base, *waiting]


def polish(model: pycolmap.Reconstruction, database: Path, folder: Path, threads: int, fixed: bool) -> None:
    """Triangulate all points anew from the poses of a model, and adjust both, two times.

    Args:
        model: with poses; it is changed.
        database: with the verified pairs of its images.
        folder: for temporary files.
        threads: how many.
        fixed: whether cameras stay as they are.
    """
    triangulation = pycolmap.IncrementalPipelineOptions()
    triangulation.num_threads, triangulation.random_seed, triangulation.extract_colors = threads, 0, False
    adjustment = pycolmap.BundleAdjustmentOptions()
    adjustment.refine_focal_length = adjustment.refine_extra_params = not fixed
    adjustment.ceres.solver_options.num_threads = threads
    adjustment.ceres.loss_function_type = pycolmap.LossFunctionType.SOFT_L1
    folder.mkdir(parents=True, exist_ok=True)
    for _ in range(2):
        pycolmap.triangulate_points(model, database, folder, folder, options=triangulation)
        pycolmap.bundle_adjustment(model, adjustment)
