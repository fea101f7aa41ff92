"""Observations of points by the cameras of a map: their image errors, and derivatives of these.

A camera's movement is (turn in the camera's own axes, movement in the world's). Derivatives are kept as one row of
numbers for each unknown, O long, and are worked on in parts that fit a processor's cache.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from lightning_pose.mapping.camera_correction import CameraCorrection
from lightning_pose.mapping.threads import map_in_threads

__all__ = ["N_CAMERA", "Cameras", "Observations", "View"]

PART = 2**13
"""Observations worked on at once: as many as fit a processor's cache."""

N_CAMERA = 5
"""Numbers of all cameras: scale, centre x and y, k1, readout."""


class Cameras(NamedTuple):
    """Where the cameras of all frames are, and what is wrong with the assumed one.

    Attributes:
        rotation: (F, 3, 3), camera-to-world.
        position: (F, 3).
        correction: of the assumed camera.
        readout: of a rolling shutter, as `Adjustment` has it.
    """

    rotation: np.ndarray
    position: np.ndarray
    correction: CameraCorrection
    readout: float


@dataclass(frozen=True)
class Observations:
    """O observations of T points in F frames.

    Attributes:
        track: (O,) int64, the point of each observation, ascending; each point has one at least.
        frame: (O,) int64.
        observed: (2, O), normalised image coordinates.
        sigma: (O,), scale of Cauchy's weights, in normalised image coordinates.
        turn_rate: (3, F), of each frame, as `find_turn_rates` has it; zeros for a global shutter.
    """

    track: np.ndarray
    frame: np.ndarray
    observed: np.ndarray
    sigma: np.ndarray
    turn_rate: np.ndarray

    def part(self, first: int, last: int) -> Observations:
        """Those of the points from `first` to before `last`, which are numbered from 0."""
        rows = slice(*np.searchsorted(self.track, [first, last]))
        return Observations(
            self.track[rows] - first, self.frame[rows], self.observed[:, rows], self.sigma[rows], self.turn_rate
        )

    def ends(self) -> list[tuple[int, int]]:
        """The first point and the one after the last of each part."""
        starts = np.unique(self.track[::PART]).tolist()
        return list(pairwise([*starts, int(self.track[-1]) + 1]) if len(self.track) else [])

    def cost(self, cameras: Cameras, points: np.ndarray) -> float:
        """Cauchy's cost of the image errors; `points` is (T, 3)."""

        def add_up(ends: tuple[int, int]) -> float:
            view = View(self.part(*ends), cameras, points[slice(*ends)])
            squared = np.where(view.in_front, view.error_u**2 + view.error_v**2, 1e6 * view.seen.sigma**2)
            return float(np.log1p(squared / view.seen.sigma**2).sum())

        return sum(map_in_threads(add_up, self.ends()))


class View:
    """What some observations see of their points: rows of O numbers."""

    def __init__(self, seen: Observations, cameras: Cameras, points: np.ndarray) -> None:
        self.seen, self.camera = seen, cameras.correction
        columns = np.concatenate([cameras.rotation.reshape(-1, 9), cameras.position], axis=1)
        gathered = columns.T.take(seen.frame, axis=1)
        self.axes = gathered[:9].reshape(3, 3, -1)  # world, camera
        away = points.T.take(seen.track, axis=1) - gathered[9:]
        x, y, z = (self.axes * away[:, None]).sum(axis=0)
        self.in_front = z > 0
        self.by_depth = 1 / np.maximum(z, 1e-9)
        self.u, self.v = u, v = x * self.by_depth, y * self.by_depth
        uv = u * v
        self.turn_u, self.turn_v = np.stack([uv, -1 - u * u, v]), np.stack([1 + v * v, -uv, -u])
        turn_rate = seen.turn_rate.take(seen.frame, axis=1)
        self.rolling_u, self.rolling_v = ((turn * turn_rate).sum(axis=0) * v for turn in (self.turn_u, self.turn_v))
        rolled_u, rolled_v = u + cameras.readout * self.rolling_u, v + cameras.readout * self.rolling_v
        bent = self.camera.scale * (1 + self.camera.k1 * (rolled_u**2 + rolled_v**2))
        self.error_u = rolled_u * bent + (self.camera.centre[0] - seen.observed[0])
        self.error_v = rolled_v * bent + (self.camera.centre[1] - seen.observed[1])

    def derive(self) -> tuple[np.ndarray, np.ndarray]:
        """Weighted, (12, O) each: derivatives of both errors by a camera's movement and numbers; then the errors."""
        u, v, camera = self.u, self.v, self.camera
        squared = u * u + v * v
        straight, cross = camera.scale * (1 + camera.k1 * squared), 2 * camera.scale * camera.k1
        uu, uv, vv = straight + cross * u * u, cross * u * v, straight + cross * v * v
        error = (self.error_u**2 + self.error_v**2) / self.seen.sigma**2
        root = np.where(self.in_front, 1 / (np.sqrt(1 + error) * self.seen.sigma), 0.0)
        ray_x, ray_y, ray_z = self.axes.swapaxes(0, 1)
        moved_u, moved_v = (u * ray_z - ray_x) * self.by_depth, (v * ray_z - ray_y) * self.by_depth
        by_u, by_v = np.empty((12, len(u))), np.empty((12, len(u)))
        for rows, plain_u, plain_v in ((slice(3), self.turn_u, self.turn_v), (slice(3, 6), moved_u, moved_v)):
            by_u[rows], by_v[rows] = uu * plain_u + uv * plain_v, uv * plain_u + vv * plain_v
        one, bent = 1 + camera.k1 * squared, camera.scale * squared
        by_u[6:], by_v[6:] = 0.0, 0.0
        by_u[6], by_v[6] = u * one, v * one
        by_u[7] = by_v[8] = 1.0
        by_u[9], by_v[9] = u * bent, v * bent
        by_u[10], by_v[10] = self.rolling_u, self.rolling_v
        by_u[11], by_v[11] = self.error_u, self.error_v
        return by_u * root, by_v * root
