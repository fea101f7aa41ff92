"""How far a map's answers are off: its own training frames, located without what they themselves contributed."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lightning_pose.geometry.absolute_pose import CameraPose
from lightning_pose.mapping.build_map import MappedFrames, summarize_tracks, triangulate_tracks
from lightning_pose.mapping.map_localizer import MapAnswer, MapLocalizer

__all__ = ["Calibration", "calibrate_map"]

BLOCKS = 5
"""Parts of the training frames, each consecutive, left out in turn."""

FRAMES_PER_BLOCK = 40
"""Frames of each block that are located, evenly spread."""

COVERAGE = 0.9
"""Share of accepted answers that are to lie within their radius."""

MIN_ANSWERS = 10
"""Fewer accepted answers are no ground for a radius."""


@dataclass(frozen=True)
class Calibration:
    """What the training frames say about the map's errors.

    Attributes:
        position_factor: by which an answer's `position_sd` becomes a radius that holds 90 % of positions; nan where
            too few frames were accepted to know.
        orientation_factor: the same for `orientation_sd_deg`.
        position_error: median error of the frames left out, in the scene's unit, refused ones included.
        orientation_error_deg: the same.
        accepted: share of the frames that the map accepted.
    """

    position_factor: float
    orientation_factor: float
    position_error: float
    orientation_error_deg: float
    accepted: float


def calibrate_map(mapped: MappedFrames) -> Calibration:
    """Leave out blocks of training frames in turn, and compare the map's answers for them with their given poses.

    A block's observations leave the points that they helped to place, and its frames lend no offset to an answer.

    Returns:
        radii by conformal prediction (Vovk, Gammerman, Shafer, 2005): the factor is the quantile of error by standard
        deviation among the accepted.
    """
    position, orientation, accepted, ratios = [], [], [], []
    for block in np.array_split(np.arange(len(mapped.given)), BLOCKS):
        kept = ~np.isin(mapped.tracks.frame, block)
        if not kept.any() or not len(block):
            continue
        tracks = triangulate_tracks(mapped.seen, mapped.tracks.select(kept))
        point_map = summarize_tracks(MappedFrames(mapped.given, mapped.seen, tracks, mapped.camera))
        localizer = MapLocalizer(point_map, without=block)
        for frame in block[:: max(1, len(block) // FRAMES_PER_BLOCK)].tolist():
            answer = localizer.locate(mapped.given.query(frame))
            errors = _measure_errors(answer, mapped.given.rotation[frame], mapped.given.position[frame])
            position.append(errors[0])
            orientation.append(errors[1])
            accepted.append(answer.accepted)
            if answer.accepted:
                ratios.append((errors[0] / answer.position_sd, errors[1] / answer.orientation_sd_deg))
    factors = _find_quantiles(np.array(ratios).reshape(-1, 2))
    if not position:
        return Calibration(*factors, np.nan, np.nan, 0.0)
    return Calibration(*factors, float(np.median(position)), float(np.median(orientation)), float(np.mean(accepted)))


def _measure_errors(answer: MapAnswer, rotation: np.ndarray, position: np.ndarray) -> tuple[float, float]:
    """Distance to the given position, and angle to the given rotation in degrees."""
    pose: CameraPose = answer.pose
    half_sine = np.linalg.norm(pose.rotation - rotation) / np.sqrt(8)
    return float(np.linalg.norm(pose.position - position)), float(np.degrees(2 * np.arcsin(min(half_sine, 1.0))))


def _find_quantiles(ratios: np.ndarray) -> tuple[float, float]:
    """For each column of (N, 2), the smallest value that at least 90 % of a further answer's would not exceed."""
    n = len(ratios)
    if n < MIN_ANSWERS:
        return np.nan, np.nan
    rank = min(int(np.ceil((n + 1) * COVERAGE)), n) - 1
    position, orientation = np.sort(ratios, axis=0)[rank].tolist()
    return position, orientation
