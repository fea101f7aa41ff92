"""A made building for the benchmark of map growth: rooms of textured points, and what a walking camera sees of them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from lightning_pose.mapping.frames import MapFrames

__all__ = ["Building", "make_building", "walk_through"]

ROOM_M = np.array([5.0, 5.0, 2.6])
POINTS_PER_ROOM = 1200
FRAMES_PER_ROOM = 500
KEYPOINTS = 300
CLUTTER = 60
"""Keypoints of each frame that are of nothing in particular."""

REPEATED = 0.75
"""Share of the points in view whose keypoints are found."""

WIDTH, HEIGHT, FOCAL_PX = 640, 480, 525.0
NOISE_PX = 0.7
COLUMNS = 64
POSE_NOISE = (0.003, 0.008)
"""Of the given poses, drifting over some ten frames: radians, metres."""


@dataclass(frozen=True)
class Building:
    """R rooms with S points each: places (R, S, 3), sizes in metres (R, S), and unit descriptors (R, S, 64)."""

    points: np.ndarray
    size_m: np.ndarray
    descriptors: np.ndarray
    corner: np.ndarray


def make_building(rooms: int) -> Building:
    """Rooms side by side in a square, points on their walls, floors, ceilings, and on boxes inside."""
    rng = np.random.default_rng(0)
    side = int(np.ceil(np.sqrt(rooms)))
    row, column = np.divmod(np.arange(rooms), side)
    corner = np.column_stack([column * (ROOM_M[0] + 0.2), row * (ROOM_M[1] + 0.2), np.zeros(rooms)])
    place = rng.random((rooms, POINTS_PER_ROOM, 3))
    face = rng.integers(0, 6, (rooms, POINTS_PER_ROOM))
    for axis in range(3):
        place[..., axis] = np.where(face == 2 * axis, 0.0, np.where(face == 2 * axis + 1, 1.0, place[..., axis]))
    inside = rng.random((rooms, POINTS_PER_ROOM)) < 0.3
    place = np.where(inside[..., None], 0.15 + 0.2 * place + 0.5 * rng.random((rooms, 1, 3)), place)
    size_m = 0.02 * 2 ** rng.uniform(0, 2.5, (rooms, POINTS_PER_ROOM))
    return Building(corner[:, None] + place * ROOM_M, size_m, _make_descriptors(rng, (rooms, POINTS_PER_ROOM)), corner)


def walk_through(building: Building, per_room: int, seed: int) -> tuple[MapFrames, np.ndarray, np.ndarray]:
    """Frames of a walk through all rooms, with drifting poses; also the true rotations (F, 3, 3) and positions (F, 3).

    The walks of different seeds lie beside each other.
    """
    rng = np.random.default_rng([seed, 1])
    rooms = len(building.points)
    t = (np.arange(per_room) + rng.random()) / per_room
    phase = np.random.default_rng(2).uniform(0, 2 * np.pi, (rooms, 3, 1)) + 0.25 * seed
    yaw = phase[:, 0] + 4 * np.pi * t
    place = np.stack(
        [0.5 + 0.22 * np.cos(yaw / 2 + phase[:, 1]), 0.5 + 0.22 * np.sin(yaw / 2 + phase[:, 2]), 0.55 + 0 * yaw]
    )
    place[2] += 0.05 * np.sin(3 * yaw)
    position = (building.corner[:, None] + np.moveaxis(place, 0, 2) * ROOM_M).reshape(-1, 3)
    tilt = 0.15 * np.sin(1.5 * yaw + phase[:, 1])
    forward = np.stack([np.cos(yaw) * np.cos(tilt), np.sin(yaw) * np.cos(tilt), np.sin(tilt)], axis=2).reshape(-1, 3)
    right = np.cross(forward, [0, 0, 1.0])
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    rotation = np.stack([right, np.cross(forward, right), forward], axis=2)
    n = len(position)
    frames = MapFrames(
        np.zeros((n, KEYPOINTS, 2)), np.zeros((n, KEYPOINTS), np.float32),
        np.zeros((n, KEYPOINTS, COLUMNS), np.float32), np.zeros(n, np.int64), np.full(n, FOCAL_PX),
        np.tile([WIDTH / 2 / FOCAL_PX, HEIGHT / 2 / FOCAL_PX], (n, 1)), rotation, position,
    )  # fmt: skip
    for i in range(n):
        _look(frames, i, building, i // per_room, rng)
    drift = rng.normal(size=(n + 20, 6))
    drift = np.stack([np.convolve(column, np.ones(21) / np.sqrt(21), "valid") for column in drift.T], axis=1)
    turned = rotation @ Rotation.from_rotvec(drift[:, :3] * POSE_NOISE[0]).as_matrix()
    return frames.with_poses(turned, position + drift[:, 3:] * POSE_NOISE[1]), rotation, position


def _look(frames: MapFrames, i: int, building: Building, room: int, rng: np.random.Generator) -> None:
    """Fill in the keypoints of frame `i`, which is in a room and sees nothing of the others."""
    local = (building.points[room] - frames.position[i]) @ frames.rotation[i]
    uv = local[:, :2] / np.maximum(local[:, 2:], 1e-9)
    shown = (local[:, 2] > 0.3) & (np.abs(uv) < frames.half_view[i]).all(axis=1) & (rng.random(len(uv)) < REPEATED)
    seen = rng.permutation(np.flatnonzero(shown))[: KEYPOINTS - CLUTTER]
    n, k = len(seen), len(seen) + CLUTTER
    noise = NOISE_PX / FOCAL_PX
    frames.points[i, :n] = uv[seen] + rng.normal(0, noise, (n, 2))
    frames.points[i, n:k] = rng.uniform(-1, 1, (CLUTTER, 2)) * frames.half_view[i]
    distance = np.linalg.norm(local[seen], axis=1)
    frames.size_px[i, :n] = building.size_m[room, seen] / distance * FOCAL_PX * 2 ** rng.normal(0, 0.15, n)
    frames.size_px[i, n:k] = 12 * 2 ** rng.uniform(0, 2, CLUTTER)
    near = building.descriptors[room, seen] + rng.normal(0, 0.25 / np.sqrt(COLUMNS), (n, COLUMNS))
    frames.descriptors[i, :n] = near / np.linalg.norm(near, axis=1, keepdims=True)
    frames.descriptors[i, n:k] = _make_descriptors(rng, (CLUTTER,))
    frames.count[i] = k


def _make_descriptors(rng: np.random.Generator, shape: tuple[int, ...]) -> np.ndarray:
    """Unit descriptors (..., 64) that are about 1 from each other, as those of SURF are."""
    common = np.random.default_rng(1).normal(size=COLUMNS)
    rows = common + rng.normal(size=(*shape, COLUMNS))
    return (rows / np.linalg.norm(rows, axis=-1, keepdims=True)).astype(np.float32)
