"""How far a map's answers are off: its own training frames, located without what they themselves contributed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from lightning_pose.mapping.build_map import MappedFrames, summarize_tracks
from lightning_pose.mapping.frames import MapFrames
from lightning_pose.mapping.map_localizer import MapAnswer, MapLocalizer
from lightning_pose.mapping.point_map import PointMap
from lightning_pose.mapping.threads import map_in_threads
from lightning_pose.mapping.track_points import GATES_PX, triangulate_tracks

__all__ = [
    "MIN_ANSWERS",
    "UNKNOWN",
    "Calibration",
    "Measured",
    "calibrate_answers",
    "calibrate_map",
    "choose_map",
    "find_conformal_factor",
    "locate_frames",
    "measure_answers",
    "measure_frames",
    "measure_left_out",
]

BLOCKS = 5
"""Parts of the training frames, each consecutive, left out in turn."""

MOST_MEASURED = 200
"""Frames whose errors are measured in all; half of them at least are training frames left out, evenly spread."""

COVERAGE = 0.9
"""Share of accepted answers that are to lie within their radius."""

MOST_CHOOSING = 60
"""Frames that say which of some maps is best."""

MIN_ANSWERS = 10
"""Fewer accepted answers are no ground for a radius."""


@dataclass(frozen=True)
class Calibration:
    """What the training frames say about the map's errors.

    Attributes:
        position_factor: by which an answer's `position_sd` becomes a radius that holds 90 % of positions; nan where
            too few frames were accepted.
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


UNKNOWN = Calibration(np.nan, np.nan, np.nan, np.nan, 0.0)
"""Where nothing was left out."""


def calibrate_map(mapped: MappedFrames, others: Measured | None = None) -> Calibration:
    """What answers for training frames that are left out say about the map's errors.

    Args:
        mapped: frames and tracks of the map.
        others: errors of frames that a map of the same scene did not have, such as validation frames before they were
            added. They are nearer to the map's frames than a block that is left out.

    Returns:
        radii by conformal prediction (Vovk, Gammerman, Shafer, 2005): the factor is the quantile of error by standard
        deviation among the accepted.
    """
    known = 0 if others is None else len(others.accepted)
    found = [measure_left_out(mapped, max(MOST_MEASURED // 2, MOST_MEASURED - known))]
    found += [] if others is None else [others]
    every = Measured(*(np.concatenate(parts) for parts in zip(*found, strict=True)))
    return calibrate_answers(every) if len(every.accepted) else UNKNOWN


def measure_left_out(mapped: MappedFrames, most: int = MOST_MEASURED) -> Measured:
    """Leave out blocks of training frames in turn, and compare the map's answers for them with their given poses.

    A block's observations leave the points that they helped to place, and its frames lend no offset to an answer.

    Args:
        mapped: frames and tracks of the map.
        most: frames that are located, about.
    """

    def measure_block(block: np.ndarray) -> Measured:
        kept = ~np.isin(mapped.tracks.frame, block)
        if not kept.any() or not len(block):
            return measure_answers([], mapped.given.select(block[:0]))
        tracks = triangulate_tracks(mapped.seen, mapped.tracks.select(kept), GATES_PX[-1:])  # points hardly move
        localizer = MapLocalizer(summarize_tracks(replace(mapped, tracks=tracks)), without=block)
        frames = mapped.given.select(block[:: max(1, len(block) * BLOCKS // most)])
        return measure_answers([localizer.locate(frames.query(i)) for i in range(len(frames))], frames)

    blocks = np.array_split(np.arange(len(mapped.given)), BLOCKS)
    return Measured(*(np.concatenate(parts) for parts in zip(*map_in_threads(measure_block, blocks), strict=True)))


def calibrate_answers(found: Measured) -> Calibration:
    """What answers for frames that the map does not have say about its errors."""
    accepted = found.accepted
    return Calibration(
        find_conformal_factor((found.position / found.position_sd)[accepted]),
        find_conformal_factor((found.orientation_deg / found.orientation_sd_deg)[accepted]),
        float(np.median(found.position)),
        float(np.median(found.orientation_deg)),
        float(accepted.mean()),
    )


class Measured(NamedTuple):
    """Errors of answers against given poses, (N,) each, in the scene's unit and degrees."""

    position: np.ndarray
    orientation_deg: np.ndarray
    accepted: np.ndarray
    position_sd: np.ndarray
    orientation_sd_deg: np.ndarray
    inliers: np.ndarray

    @property
    def mean_log_error(self) -> float:
        """Of positions and orientations; of few frames it varies less than their medians. inf without frames."""
        errors = np.stack([self.position, self.orientation_deg])
        return float(np.log(np.maximum(errors, np.finfo(float).tiny)).mean()) if errors.size else np.inf


def choose_map(maps: Sequence[PointMap], frames: MapFrames) -> tuple[int, list[MapAnswer]]:
    """Which of some maps locates frames best, `MOST_CHOOSING` of them evenly spread, and its answers for all."""
    localizers, n = [MapLocalizer(each) for each in maps], len(frames)
    some = np.unique(np.linspace(0, n - 1, min(n, MOST_CHOOSING)).round().astype(int))
    answers = [locate_frames(localizer, frames.select(some)) for localizer in localizers]
    best = int(np.argmin([measure_answers(each, frames.select(some)).mean_log_error for each in answers]))
    others = np.setdiff1d(np.arange(n), some)
    found = dict(zip(some.tolist(), answers[best], strict=True))
    found.update(zip(others.tolist(), locate_frames(localizers[best], frames.select(others)), strict=True))
    return best, [found[i] for i in range(n)]


def measure_frames(localizer: MapLocalizer, frames: MapFrames) -> Measured:
    """Locate frames, and compare the answers with the poses that the frames have."""
    return measure_answers(locate_frames(localizer, frames), frames)


def locate_frames(localizer: MapLocalizer, frames: MapFrames) -> list[MapAnswer]:
    """Answers for frames, whose own poses are not used."""
    return map_in_threads(lambda i: localizer.locate(frames.query(i)), range(len(frames)))


def measure_answers(answers: Sequence[MapAnswer], frames: MapFrames) -> Measured:
    """Compare answers for frames with the poses that the frames have."""
    rotation = np.array([answer.pose.rotation for answer in answers]).reshape(-1, 3, 3)
    position = np.array([answer.pose.position for answer in answers]).reshape(-1, 3)
    half_sine = np.linalg.norm(rotation - frames.rotation, axis=(1, 2)) / np.sqrt(8)
    return Measured(
        np.linalg.norm(position - frames.position, axis=1),
        np.degrees(2 * np.arcsin(np.minimum(half_sine, 1.0))),
        np.array([answer.accepted for answer in answers], bool),
        np.array([answer.position_sd for answer in answers]),
        np.array([answer.orientation_sd_deg for answer in answers]),
        np.array([answer.inliers for answer in answers]),
    )


def find_conformal_factor(ratios: np.ndarray) -> float:
    """The smallest value that at least 90 % of further ratios would not exceed; nan for too few ratios.

    A sample has more small ratios than there are, or fewer: one standard deviation of their number is added.
    """
    n = len(ratios)
    if n < MIN_ANSWERS:
        return np.nan
    rank = min(int(np.ceil((n + 1) * COVERAGE + np.sqrt(n * COVERAGE * (1 - COVERAGE)))), n)
    return float(np.sort(ratios)[rank - 1])
