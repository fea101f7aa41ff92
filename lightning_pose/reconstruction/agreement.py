"""Measures how well poses explain the matches that they were found from, without any truth."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pycolmap

from lightning_pose.geometry.epipolar import essential_matrices, sampson_distances_px

__all__ = ["MatchedPair", "count_agreeing", "drop_poor_frames", "measure_span"]

TOLERANCE_PX = 3.0
"""Sampson distance within which a match lies on its epipolar line."""

MIN_POINTS = 15
"""A frame that sees fewer points has no sure pose."""

MIN_SHARE = 0.6
"""Share of a frame's matches that must agree with its pose: 0.44 of the one frame of a walk that was metres off,
0.71 or more of the others."""

MatchedPair = tuple[int, int, np.ndarray]
"""Numbers of two images, and (K, 2) rows of their keypoints that match."""


def count_agreeing(model: pycolmap.Reconstruction, pairs: Sequence[MatchedPair]) -> int:
    """How many matches lie on the epipolar lines of the poses; none of frames without a pose."""
    return int(_count_by_pair(model, pairs).sum())


def drop_poor_frames(model: pycolmap.Reconstruction, pairs: Sequence[MatchedPair]) -> list[int]:
    """Take away the poses of frames that see too few points, or whose matches mostly disagree with their poses.

    Returns:
        the numbers of their images.
    """
    agreeing, all_matches = (dict.fromkeys(model.reg_image_ids(), 0) for _ in range(2))
    for (a, b, rows), count in zip(pairs, _count_by_pair(model, pairs).tolist(), strict=True):
        if a in agreeing and b in agreeing:
            for number in (a, b):
                agreeing[number] += count
                all_matches[number] += len(rows)
    poor = [
        number
        for number in sorted(agreeing)
        if model.image(number).num_points3D < MIN_POINTS or agreeing[number] < MIN_SHARE * all_matches[number]
    ]
    for number in poor:
        model.deregister_frame(model.image(number).frame_id)
    return poor


def measure_span(model: pycolmap.Reconstruction) -> float:
    """Extent of the camera centres, as a share of the median distance from them to the points."""
    centres = np.array([model.image(number).projection_center() for number in model.reg_image_ids()])
    points = np.array([point.xyz for point in model.points3D.values()])
    if not len(points):
        return 0.0
    some = centres[:: max(len(centres) // 20, 1)]
    distance = np.median([np.median(np.linalg.norm(points - centre, axis=1)) for centre in some])
    return float(np.linalg.norm(np.ptp(centres, axis=0)) / distance)


def _count_by_pair(model: pycolmap.Reconstruction, pairs: Sequence[MatchedPair]) -> np.ndarray:
    """(P,) int64, how many matches of each pair lie on the epipolar lines of the poses; 0 without poses."""
    posed = set(model.reg_image_ids())
    counts = np.zeros(len(pairs), np.int64)
    rows_of_pairs = [row for row, pair in enumerate(pairs) if pair[0] in posed and pair[1] in posed]
    pairs = [pairs[row] for row in rows_of_pairs]
    if not pairs:
        return counts
    rays, focal_px, rotation, position = {}, {}, {}, {}
    for number in posed:
        image = model.image(number)
        camera = model.camera(image.camera_id)
        pixels = np.array([point.xy for point in image.points2D]).reshape(-1, 2)
        rays[number], focal_px[number] = np.asarray(camera.cam_from_img(pixels)), camera.mean_focal_length()
        rotation[number] = image.cam_from_world().rotation.matrix().T
        position[number] = image.projection_center()
    ends = [[pair[side] for pair in pairs] for side in (0, 1)]
    first, second = ((np.array([rotation[i] for i in side]), np.array([position[i] for i in side])) for side in ends)
    essentials = essential_matrices(*first, *second)
    for row, (a, b, rows), essential in zip(rows_of_pairs, pairs, essentials, strict=True):
        focal = (focal_px[a] + focal_px[b]) / 2
        matches = np.broadcast_to(essential, (len(rows), 3, 3))
        error = sampson_distances_px(matches, focal * rays[a][rows[:, 0]], focal * rays[b][rows[:, 1]], focal)
        counts[row] = (error < TOLERANCE_PX).sum()
    return counts
