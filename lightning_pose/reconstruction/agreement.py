"""Measures how well poses explain the matches that they were found from, without any truth."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pycolmap

from lightning_pose.geometry.epipolar import essential_matrices, sampson_distances_px

__all__ = ["MatchedPair", "count_agreeing"]

TOLERANCE_PX = 3.0
"""Sampson distance within which a match lies on its epipolar line."""

MatchedPair = tuple[int, int, np.ndarray]
"""Numbers of two images, and (K, 2) rows of their keypoints that match."""


def count_agreeing(model: pycolmap.Reconstruction, pairs: Sequence[MatchedPair]) -> int:
    """How many matches lie on the epipolar lines of the poses; none of frames without a pose."""
    posed = set(model.reg_image_ids())
    pairs = [pair for pair in pairs if pair[0] in posed and pair[1] in posed]
    if not pairs:
        return 0
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
    agreeing = 0
    for (a, b, rows), essential in zip(pairs, essential_matrices(*first, *second), strict=True):
        focal = (focal_px[a] + focal_px[b]) / 2
        matches = np.broadcast_to(essential, (len(rows), 3, 3))
        error = sampson_distances_px(matches, focal * rays[a][rows[:, 0]], focal * rays[b][rows[:, 1]], focal)
        agreeing += int((error < TOLERANCE_PX).sum())
    return agreeing
