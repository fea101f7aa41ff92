"""The synthetic room: the textured rectangles of its walls, furniture and pictures, with light in their textures.

The world's origin is the middle of the floor; x points along the longer walls, y to the wall that the camera mostly
looks at, z up; metres.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from itertools import pairwise

import cv2
import numpy as np

from lightning_pose.scenes.synthetic import textures
from lightning_pose.scenes.synthetic.posters import paint_poster
from lightning_pose.scenes.synthetic.sessions import Session, make_session, move_furniture

__all__ = ["TEXELS_PER_M", "Quad", "Room", "make_room", "measure_room"]

TEXELS_PER_M = 256
"""Pixels of a texture per metre."""

Paint = Callable[[np.random.Generator, int, int], np.ndarray]
RIGHT = {
    "-y": (1, 0, 0),
    "+y": (-1, 0, 0),
    "-x": (0, -1, 0),
    "+x": (0, 1, 0),
    "+z": (1, 0, 0),
    "-z": (1, 0, 0),
}
DOWN = {"+z": (0, -1, 0), "-z": (0, 1, 0)}
"""World axes of a texture's rows and columns by the direction that a surface faces; columns of walls point down."""


@dataclass(frozen=True)
class Quad:
    """A textured rectangle, visible from one side, from which u points right and v down.

    Attributes:
        corner: (3,) world position of the texture's top left corner.
        u: (3,) edge along the texture's rows.
        v: (3,) edge along the texture's columns.
        texture: (H, W, 3) uint8 BGR, light included.
    """

    corner: np.ndarray
    u: np.ndarray
    v: np.ndarray
    texture: np.ndarray


@dataclass(frozen=True)
class Room:
    """All rectangles of a room, and its extent (3,) along x, y and z in metres."""

    quads: tuple[Quad, ...]
    size_m: np.ndarray


def make_room(seed: int, session: int = 0) -> Room:
    """Make the room of a seed, which chooses dimensions, surfaces, furniture, pictures and lamps, as at a visit."""
    rng = np.random.default_rng([seed, 0])
    size = _draw_size(rng)
    boxes = _place_furniture(rng, size)
    lamps = np.array([(-size[0] / 4, 0.1, size[2] - 0.15), (size[0] / 4, -0.3, size[2] - 0.15)])
    lamps += rng.uniform(-0.5, 0.5, (2, 3)) * (1, 1, 0)
    bare = [*_make_shell(rng, size), *_hang_pictures(rng, size)]
    shift_m, kept = move_furniture(seed, session, size, np.array(boxes))
    for box, shift, there in zip(boxes, shift_m, kept, strict=True):
        faces = list(_make_box_faces(rng, *box))  # painted before they move, so that the same box looks the same
        bare += [replace(face, corner=face.corner + shift) for face in faces if there]
    solid = (np.array(boxes) + shift_m[:, None])[kept]
    light = make_session(seed, session)
    return Room(tuple(_bake_light(quad, size, solid, lamps + light.lamp_shift_m, light) for quad in bare), size)


def measure_room(seed: int) -> np.ndarray:
    """The extent (3,) of the room of a seed along x, y and z in metres, without making it."""
    return _draw_size(np.random.default_rng([seed, 0]))


def _draw_size(rng: np.random.Generator) -> np.ndarray:
    return rng.uniform((5.4, 3.8, 2.5), (6.6, 4.4, 2.9))


def _make_face(
    rng: np.random.Generator, paint: Paint, center: np.ndarray, facing: str, width_m: float, height_m: float
) -> Quad:
    """Make a rectangle of a size around a centre; its visible side faces along a world axis."""
    u, v = width_m * np.array(RIGHT[facing]), height_m * np.array(DOWN.get(facing, (0, 0, -1)))
    texture = paint(rng, round(height_m * TEXELS_PER_M), round(width_m * TEXELS_PER_M))
    return Quad(center - u / 2 - v / 2, u, v, texture)


def _make_shell(rng: np.random.Generator, size: np.ndarray) -> Iterator[Quad]:
    """Make walls, floor, ceiling and a rug."""
    x, y, z = size
    main, side = textures.paint_bricks, textures.paint_wallpaper
    if rng.random() < 0.5:
        main, side = side, main
    floor = textures.paint_planks if rng.random() < 0.5 else textures.paint_tiles
    yield _make_face(rng, main, np.array([0, y / 2, z / 2]), "-y", x, z)
    yield _make_face(rng, main, np.array([0, -y / 2, z / 2]), "+y", x, z)
    yield _make_face(rng, side, np.array([x / 2, 0, z / 2]), "-x", y, z)
    yield _make_face(rng, side, np.array([-x / 2, 0, z / 2]), "+x", y, z)
    yield _make_face(rng, floor, np.array([0, 0, 0]), "+z", x, y)
    yield _make_face(rng, textures.paint_panels, np.array([0, 0, z]), "-z", x, y)
    yield _make_face(rng, textures.paint_rug, np.array([rng.uniform(-0.5, 0.5), 0.1, 0.006]), "+z", 2.8, 1.6)


def _hang_pictures(rng: np.random.Generator, size: np.ndarray) -> Iterator[Quad]:
    """Make one picture, or two above each other, on each metre of every wall."""
    x, y, z = size
    for facing, wall, length in (
        ("-y", np.array([0, y / 2 - 0.01, 0]), x),
        ("+y", np.array([0, -y / 2 + 0.01, 0]), x),
        ("-x", np.array([x / 2 - 0.01, 0, 0]), y),
        ("+x", np.array([-x / 2 + 0.01, 0, 0]), y),
    ):
        slots = np.linspace(-length / 2 + 0.1, length / 2 - 0.1, round(length) + 1)
        for left, right in pairwise(slots):
            edges = [0.75, z - 0.15] if rng.random() < 0.4 else [0.75, rng.uniform(1.4, 1.7), z - 0.15]
            for low, high in pairwise(edges):
                w, h = (right - left) * rng.uniform(0.6, 0.92), (high - low) * rng.uniform(0.6, 0.92)
                along = (left + right) / 2 + rng.uniform(-0.5, 0.5) * (right - left - w)
                height = (low + high) / 2 + rng.uniform(-0.5, 0.5) * (high - low - h)
                center = wall + along * np.array(RIGHT[facing]) + (0, 0, height)
                yield _make_face(rng, paint_poster, center, facing, w, h)


def _place_furniture(rng: np.random.Generator, size: np.ndarray) -> list[np.ndarray]:
    """Choose boxes along the far wall and both side walls, and smaller boxes upon them.

    Returns:
        arrays (2, 3): lowest and highest corner of each box.
    """
    x, y, _ = size
    standing: list[np.ndarray] = []
    at = -x / 2 + 0.05
    while at < x / 2 - 0.9:
        w, d, h = rng.uniform((0.5, 0.3, 0.4), (1.2, 0.6, 0.95))
        if rng.random() < 0.25:
            h = rng.uniform(1.5, 1.95)
        standing.append(np.array([(at, y / 2 - 0.02 - d, 0), (at + w, y / 2 - 0.02, h)]))
        at += w + rng.uniform(0.1, 0.7)
    for side in (-1, 1):
        at = y / 2 - 0.75
        while at > -y / 2 + 0.7:
            w, d, h = rng.uniform((0.4, 0.3, 0.35), (0.9, 0.5, 1.1))
            wall = side * (x / 2 - 0.02)
            near, far = sorted((wall, wall - side * d))
            standing.append(np.array([(near, at - w, 0), (far, at, h)]))
            at -= w + rng.uniform(0.15, 0.8)
    upon = []
    for low, high in standing:
        if high[2] < 1.2 and rng.random() < 0.75:
            extent = rng.uniform((0.4, 0.5, 0), (0.7, 0.9, 0)) * (high - low) + (0, 0, rng.uniform(0.15, 0.4))
            start = rng.uniform(low, high - extent) * (1, 1, 0) + (0, 0, high[2])
            upon.append(np.array([start, start + extent]))
    return standing + upon


def _make_box_faces(rng: np.random.Generator, low: np.ndarray, high: np.ndarray) -> Iterator[Quad]:
    """Make the four sides of a box, of one material, and its top."""
    middle, (w, d, h) = (low + high) / 2, high - low
    if low[2] > 0:
        front: Paint = textures.paint_carton
    elif h > 1.2:
        front = textures.paint_bookshelf
    else:
        front = textures.paint_drawers if rng.random() < 0.7 else textures.paint_bookshelf
    for facing, face, width in (("-y", low, w), ("+y", high, w), ("-x", low, d), ("+x", high, d)):
        axis = "xy".index(facing[1])
        center = middle.copy()
        center[axis] = face[axis]
        yield _make_face(rng, front, center, facing, width, h)
    top = textures.paint_carton if low[2] > 0 else textures.paint_planks
    yield _make_face(rng, top, np.array([middle[0], middle[1], high[2]]), "+z", w, d)


def _bake_light(quad: Quad, size: np.ndarray, boxes: np.ndarray, lamps: np.ndarray, session: Session) -> Quad:
    """Multiply a rectangle's texture by a visit's light: two lamps with soft shadows, and darker corners.

    The light is computed on a grid of about 8 points a metre and interpolated.
    """
    h, w = quad.texture.shape[:2]
    rows, columns = (max(4, round(n / TEXELS_PER_M * 8)) for n in (h, w))
    s, t = np.meshgrid((np.arange(columns) + 0.5) / columns, (np.arange(rows) + 0.5) / rows)
    normal = np.cross(quad.v, quad.u)
    normal /= np.linalg.norm(normal)
    points = quad.corner + s[..., None] * quad.u + t[..., None] * quad.v
    light = session.ambient * _compute_openness(points + 0.1 * normal, size, boxes)
    softness = 0.25 * np.array([(1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0)])
    rays = (lamps[:, None] + softness).reshape(-1, 3) - points[..., None, :]
    distance = np.linalg.norm(rays, axis=-1)
    incidence = np.clip((rays @ normal) / distance, 0, 1)
    reaches = ~_find_blocked(points[..., None, :] + 0.01 * normal, rays, boxes)
    power = np.repeat(0.145 * np.broadcast_to(session.lamp_power, 2), len(softness))
    light += (power * reaches * incidence / (0.35 + 0.1 * distance**2)).sum(-1)
    shade = cv2.resize(light.astype(np.float32), (w, h), interpolation=cv2.INTER_LINEAR)
    tinted = shade[..., None] * np.broadcast_to(session.tint, 3).astype(np.float32)
    return replace(quad, texture=textures.shade_image(quad.texture, tinted))


def _compute_openness(points: np.ndarray, size: np.ndarray, boxes: np.ndarray) -> np.ndarray:
    """Ambient light in 0..1, smaller near walls and boxes: an approximation of ambient occlusion."""
    above = points + size / 2 * (1, 1, 0)
    openness = np.prod([1 - 0.3 * np.exp(-gap / 0.25) for gap in (above, size - above)], axis=(0, -1))
    for low, high in boxes:
        gap = np.linalg.norm(np.maximum(np.maximum(low - points, points - high), 0), axis=-1)
        openness = openness * (1 - 0.3 * np.exp(-gap / 0.15))
    return openness


def _find_blocked(points: np.ndarray, rays: np.ndarray, boxes: np.ndarray) -> np.ndarray:
    """Whether a box intersects the segment from each point to the end of its ray (slab test)."""
    blocked = np.zeros(rays.shape[:-1], bool)
    inverse = 1 / np.where(np.abs(rays) < 1e-9, 1e-9, rays)
    for low, high in boxes:
        first, second = (low - points) * inverse, (high - points) * inverse
        enters, leaves = np.minimum(first, second).max(-1), np.maximum(first, second).min(-1)
        blocked |= (enters < leaves) & (leaves > 0) & (enters < 1)
    return blocked
