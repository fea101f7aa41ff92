"""Visits of the synthetic room at different times: other light, another exposure and blur, some furniture moved."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

__all__ = ["Session", "make_session", "move_furniture"]

MOVED, TAKEN = 0.5, 0.3
"""Parts of the standing furniture that is moved, and of the boxes upon it that are taken away."""

REACH_M = 0.5
"""How far furniture moves at most along each axis."""

ATTEMPTS = 30


@dataclass(frozen=True)
class Session:
    """What one visit of a room has of its own. The values given here are those of the room's first visit.

    Attributes:
        lamp_shift_m: (2, 3) or a number, from where the room's lamps hang.
        lamp_power: (2,) or a number, of the lamps, 1 as usual.
        ambient: light without the lamps.
        tint: (3,) or a number, BGR factors of all light.
        exposure: factor of the image's brightness.
        shutter: fraction of the time between two frames during which the shutter is open.
        defocus_px: standard deviation of the blur of a lens out of focus, for images 320 pixels wide.
    """

    lamp_shift_m: np.ndarray | float = 0.0
    lamp_power: np.ndarray | float = 1.0
    ambient: float = 0.45
    tint: np.ndarray | float = 1.0
    exposure: float = 1.0
    shutter: float = 0.25
    defocus_px: float = 0.0


def make_session(seed: int, number: int) -> Session:
    """The visit of a room of that seed; number 0 is the first."""
    if number == 0:
        return Session()
    rng = np.random.default_rng([seed, 3, number])
    return Session(
        lamp_shift_m=rng.uniform(-0.8, 0.8, (2, 3)) * (1, 1, 0),
        lamp_power=rng.uniform(0.2, 1.6, 2),
        ambient=rng.uniform(0.3, 0.65),
        tint=rng.uniform(0.85, 1.1, 3),
        exposure=rng.uniform(0.65, 1.3),
        shutter=rng.uniform(0.1, 0.6),
        defocus_px=rng.uniform(0.0, 0.8),
    )


def move_furniture(seed: int, number: int, size: np.ndarray, boxes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Choose where furniture is at a visit; at the first, nothing has moved.

    Standing furniture moves without touching other furniture or a wall, with the boxes upon it; other boxes are taken
    away.

    Args:
        seed: of the room.
        number: of the visit.
        size: (3,) of the room.
        boxes: (B, 2, 3) lowest and highest corner of each box; those whose lowest z is 0 stand on the floor.

    Returns:
        shift_m: (B, 3).
        kept: (B,) bool.
    """
    shift_m, kept = np.zeros((len(boxes), 3)), np.ones(len(boxes), bool)
    if number == 0:
        return shift_m, kept
    rng = np.random.default_rng([seed, 4, number])
    standing = boxes[:, 0, 2] == 0
    for i in np.flatnonzero(standing):
        others = [j for j in np.flatnonzero(standing) if j != i]
        moved = rng.random() < MOVED
        for shift in rng.uniform(-REACH_M, REACH_M, (ATTEMPTS, 3)) * (1, 1, 0):
            if moved and _fits(boxes[i] + shift, size, boxes[others] + shift_m[others, None]):
                shift_m[i] = shift
                break
    for i in np.flatnonzero(~standing):
        below = standing & (boxes[:, 0, :2] <= boxes[i, 0, :2]).all(1) & (boxes[:, 1, :2] >= boxes[i, 1, :2]).all(1)
        shift_m[i] = shift_m[np.flatnonzero(below)[0]]
        kept[i] = rng.random() >= TAKEN
    return shift_m, kept


def _fits(box: np.ndarray, size: np.ndarray, others: np.ndarray) -> bool:
    """Whether a box (2, 3) is inside the room, and apart from all (N, 2, 3) others, seen from above."""
    low, high = box[:, :2]
    apart = ((low > others[:, 1, :2] + 0.02) | (high < others[:, 0, :2] - 0.02)).any(1)
    return bool((np.abs(box[:, :2]) < size[:2] / 2 - 0.01).all() and apart.all())
