"""Paths of a hand-held camera in the synthetic room: smooth splines in one volume, looking at one region."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

__all__ = ["Walk", "is_test", "make_visit", "make_walks"]

FRAMES_PER_KNOT = 8
STEP_M = 0.3
"""How far the camera's centre, and the point that it looks at, each move from knot to knot."""

ASIDE_M, FAR_M = 0.15, 9.0
"""Distance of test walks from the training knots, and for training walks a distance larger than any in the room."""

START_M = 1.0
"""Test walks start at least this far from the middle of the volume, so that the mean training pose is not close."""

WEIGHTS = np.array([1, 1, 0.7, 0.5, 0, 0.3])
"""Weights of a knot's six coordinates in the distance between knots."""


@dataclass(frozen=True)
class Walk:
    """The camera's motion in one sequence, as splines over time in frames.

    Attributes:
        position_m: (K, 3) knots of the camera centre.
        target_m: (K, 3) knots of the point it looks at.
        roll_rad: (K, 1) knots of the roll.
        tremor: (J, 6) knots of the hand's tremor, two frames apart: three in metres, three in radians.
        length: number of frames.
    """

    position_m: np.ndarray
    target_m: np.ndarray
    roll_rad: np.ndarray
    tremor: np.ndarray
    length: int

    def pose(self, frame: float) -> np.ndarray:
        """Pose (4, 4), camera-to-world, at a time in frames from the start; x right, y down, z forward."""
        knot = frame / FRAMES_PER_KNOT
        tremor = _evaluate_spline(self.tremor, frame / 2)
        position = _evaluate_spline(self.position_m, knot) + tremor[:3]
        forward = _evaluate_spline(self.target_m, knot) - position
        forward /= np.linalg.norm(forward)
        right = np.cross(forward, (0, 0, 1))
        right /= np.linalg.norm(right)
        shake = _make_rotation(tremor[3:] + np.array([0, 0, 1]) * _evaluate_spline(self.roll_rad, knot))
        pose = np.eye(4)
        pose[:3, :3] = np.stack([right, np.cross(forward, right), forward], axis=1) @ shake
        pose[:3, 3] = position
        return pose


def is_test(sequence: int) -> bool:
    """Whether a sequence, counted from 0, belongs to the test split: the third of every five does."""
    return sequence % 5 == 2


def make_walks(seed: int, size_m: np.ndarray, lengths: list[int]) -> list[Walk]:
    """Make one walk per sequence, all in the same volume of about 3 x 2 x 0.6 m, looking at the far wall.

    For training walks, each next knot is, of several candidates, the one farthest from all earlier knots in position
    and in the point looked at, so that they cover the volume. Test walks stay at `ASIDE_M` from the nearest of these.
    """
    rng = np.random.default_rng([seed, 1])
    low, high = _find_bounds(size_m)
    counts = [_count_knots(length) for length in lengths]
    knots: dict[int, np.ndarray] = {}
    seen = np.zeros((0, 6))
    for held_out in (False, True):
        for i in range(len(lengths)):
            if is_test(i) == held_out:
                knots[i] = _choose_knots(rng, low, high, counts[i], seen, ASIDE_M if held_out else FAR_M)
                seen = seen if held_out else np.concatenate([seen, knots[i]])
    return [_make_walk(rng, knots[i], length) for i, length in enumerate(lengths)]


def make_visit(seed: int, size_m: np.ndarray, session: int, length: int) -> Walk:
    """Make one walk through the volume of `make_walks` that does not depend on those of other visits."""
    rng = np.random.default_rng([seed, 1, session])
    knots = _choose_knots(rng, *_find_bounds(size_m), _count_knots(length), np.zeros((0, 6)), FAR_M)
    return _make_walk(rng, knots, length)


def _find_bounds(size_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Lowest and highest (6,) position and target of a knot."""
    near, far = -size_m[1] / 2 + 0.4, size_m[1] / 2
    return np.array([-1.5, near, 1.1, -0.8, far, 1.0]), np.array([1.5, near + 2, 1.7, 0.8, far, 1.7])


def _count_knots(length: int) -> int:
    """How many knots a walk of so many frames takes."""
    return length // FRAMES_PER_KNOT + 5


def _make_walk(rng: np.random.Generator, knots: np.ndarray, length: int) -> Walk:
    """Add a roll and a tremor to knots (K, 6) of position and target."""
    roll = np.radians(rng.uniform(-5, 5, (len(knots), 1)))
    tremor = 0.003 * rng.standard_normal((length // 2 + 5, 6))
    return Walk(knots[:, :3], knots[:, 3:], roll, tremor, length)


def _choose_knots(
    rng: np.random.Generator, low: np.ndarray, high: np.ndarray, count: int, seen: np.ndarray, aside_m: float
) -> np.ndarray:
    """Choose (count, 6) knots of position and target within bounds, a step apart, without sharp turns.

    Each is, of several candidates, the one whose distance from the nearest knot in `seen` is closest to `aside_m`.
    """

    def choose(options: np.ndarray, seen: np.ndarray) -> np.ndarray:
        gaps = np.linalg.norm((options[:, None] - seen) * WEIGHTS, axis=-1).min(1, initial=FAR_M)
        return options[np.abs(gaps - aside_m).argmin()]

    starts = rng.uniform(low, high, (48, 6))
    if aside_m < FAR_M:
        starts = starts[np.linalg.norm((starts - (low + high) / 2)[:, :2], axis=1) > START_M]
    knots = [choose(starts, seen)]
    heading = rng.standard_normal(6)
    for _ in range(count - 1):
        turns = heading + 1.3 * rng.standard_normal((24, 6)) * (1, 1, 0.4, 1, 0, 0.5)
        for part in (slice(0, 3), slice(3, 6)):
            turns[:, part] *= STEP_M / np.linalg.norm(turns[:, part], axis=1, keepdims=True)
        # A step that would leave the volume is reversed, axis by axis.
        ahead = knots[-1] + turns
        turns = np.where((ahead < low) | (ahead > high), -turns, turns)
        knots.append(choose(knots[-1] + turns, np.vstack([seen, *knots[:-2]])))
        heading = (knots[-1] - knots[-2]) / STEP_M
    return np.array(knots)


def _evaluate_spline(knots: np.ndarray, at: float) -> np.ndarray:
    """Value of a uniform Catmull-Rom spline; time 0 is at the third knot, because motion blur needs times before 0."""
    i = int(np.floor(at)) + 2
    f = at - np.floor(at)
    a, b, c, d = knots[i - 1 : i + 3]
    return b + 0.5 * f * (c - a + f * (2 * a - 5 * b + 4 * c - d + f * (3 * (b - c) + d - a)))


def _make_rotation(vector: np.ndarray) -> np.ndarray:
    """Rotation matrix (3, 3) by |vector| radians about a vector (Rodrigues' formula)."""
    angle = float(np.linalg.norm(vector)) + 1e-12
    x, y, z = vector / angle
    K = np.array([(0, -z, y), (z, 0, -x), (-y, x, 0)])
    return np.eye(3) + np.sin(angle) * K + (1 - np.cos(angle)) * K @ K
