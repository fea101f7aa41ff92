"""Matches frames in pairs, and keeps what one geometry of two views explains."""

from __future__ import annotations

import numpy as np
import pycolmap

from lightning_pose.features.matching import match_descriptors
from lightning_pose.reconstruction.database import Features
from lightning_pose.reconstruction.keypoints import scale_descriptors

__all__ = ["MIN_MATCHES", "verify_pair"]

MIN_MATCHES = 15
"""A pair with fewer matches that agree is none; COLMAP's own limit."""

MAX_TRIALS = 1000
"""Of RANSAC; COLMAP's 10,000 take a third of a second for a pair of frames that share nothing, and find no more."""


def verify_pair(
    first: Features, second: Features, cameras: tuple[pycolmap.Camera, pycolmap.Camera]
) -> pycolmap.TwoViewGeometry:
    """Match two images, and find the geometry on which most matches agree; it is empty if they are too few."""
    nothing = pycolmap.TwoViewGeometry()
    if min(len(first[0]), len(second[0])) < MIN_MATCHES:
        return nothing
    rows = match_descriptors(scale_descriptors(first[1]), scale_descriptors(second[1]))
    if len(rows[0]) < MIN_MATCHES:
        return nothing
    options = pycolmap.TwoViewGeometryOptions()
    options.min_num_inliers, options.detect_watermark = MIN_MATCHES, False
    options.ransac.random_seed, options.ransac.max_num_trials = 0, MAX_TRIALS
    points = [features[0][:, :2].astype(np.float64) for features in (first, second)]
    matches = np.stack(rows, axis=1).astype(np.uint32)
    return pycolmap.estimate_two_view_geometry(cameras[0], points[0], cameras[1], points[1], matches, options)
