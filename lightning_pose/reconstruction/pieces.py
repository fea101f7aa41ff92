"""Joins models that share no frame or a few: points that both have, found through matches, give the similarity."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pycolmap

from lightning_pose.geometry.similarity import Similarity
from lightning_pose.reconstruction.agreement import MatchedPair

__all__ = ["SharedPoints", "add_piece", "find_shared_points", "join_pieces", "polish"]

MIN_SHARED = 15
"""Points that must agree on how two pieces lie to each other."""

MIN_SHARE = 0.2
"""Share of all points that both have which must agree."""

MIN_FRAMES = 2
"""Frames of the smaller piece that these points must be seen in, so that one wrong pair joins nothing."""

TOLERANCE = 0.05
"""Distance within which a point agrees, as a share of its distance from the camera that sees it."""


class SharedPoints(NamedTuple):
    """Points that two models have in common, each in its own coordinates.

    Attributes:
        base: (N, 3).
        piece: (N, 3).
        base_depth: (N,) distance from a camera of the base that sees it.
        piece_depth: (N,) the same in the piece.
        frames: N sets of the images of the piece that see it.
    """

    base: np.ndarray
    piece: np.ndarray
    base_depth: np.ndarray
    piece_depth: np.ndarray
    frames: list[set[int]]


def find_shared_points(
    base: pycolmap.Reconstruction,
    piece: pycolmap.Reconstruction,
    pairs: Sequence[MatchedPair],
) -> SharedPoints:
    """Points of two models that are one, by matches of an image of one with an image of the other.

    Args:
        base: the one model.
        piece: the other.
        pairs: the matches. An image that both models have matches itself without being listed.
    """
    point_of_base, point_of_piece = (_list_point_numbers(model) for model in (base, piece))
    both = sorted(set(point_of_base) & set(point_of_piece))
    own = [(i, i, np.repeat(np.arange(len(point_of_base[i]))[:, None], 2, axis=1)) for i in both]
    seen: dict[tuple[int, int], set[tuple[int, int]]] = {}
    for a, b, rows in [*own, *pairs]:
        for i, j, each in ((a, b, rows), (b, a, rows[:, ::-1])):
            if i not in point_of_base or j not in point_of_piece:
                continue
            here, there = point_of_base[i][each[:, 0]], point_of_piece[j][each[:, 1]]
            for k in np.flatnonzero((here >= 0) & (there >= 0)):
                seen.setdefault((int(here[k]), int(there[k])), set()).add((i, j))
    found = sorted(seen)
    views = [min(seen[each]) for each in found]
    in_base, in_piece = (
        np.array([model.point3D(each[side]).xyz for each in found]).reshape(-1, 3)
        for side, model in enumerate((base, piece))
    )
    from_base, from_piece = (
        np.array([model.image(view[side]).projection_center() for view in views]).reshape(-1, 3)
        for side, model in enumerate((base, piece))
    )
    return SharedPoints(
        in_base,
        in_piece,
        np.linalg.norm(in_base - from_base, axis=1),
        np.linalg.norm(in_piece - from_piece, axis=1),
        [{j for _, j in seen[each]} for each in found],
    )


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
        frames = set().union(*(shared.frames[i] for i in np.flatnonzero(best)))
        if best.sum() < max(MIN_SHARED, MIN_SHARE * len(best)) or len(frames) < MIN_FRAMES:
            return None
        found = Similarity.fit(shared.piece[best], shared.base[best])
        best = _agree(found, shared)
    return found


def _agree(found: Similarity | None, shared: SharedPoints) -> np.ndarray:
    """(N,) which points lie where a similarity says, in both worlds: one that shrinks a piece to a point is none."""
    if found is None:
        return np.zeros(len(shared.base), bool)
    error = np.linalg.norm(found.apply(shared.piece) - shared.base, axis=1)
    return error < TOLERANCE * np.minimum(shared.base_depth, found.scale * shared.piece_depth)


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
    models: Sequence[pycolmap.Reconstruction], pairs: Sequence[MatchedPair]
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
