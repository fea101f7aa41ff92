"""Textures of the synthetic room's walls, floors and furniture, with detail at every scale and without repetition.

Each `paint_` function takes a random generator and a size in pixels and returns an (H, W, 3) uint8 BGR image.
"""

from __future__ import annotations

import cv2
import numpy as np

__all__ = [
    "make_noise",
    "paint_bookshelf",
    "paint_bricks",
    "paint_carton",
    "paint_drawers",
    "paint_panels",
    "paint_planks",
    "paint_rug",
    "paint_tiles",
    "paint_wallpaper",
    "pick_color",
    "shade_image",
    "write_text",
]

WORDS = [
    "north",
    "harbor",
    "lemon",
    "engine",
    "violet",
    "anchor",
    "river",
    "copper",
    "museum",
    "garden",
    "signal",
    "winter",
    "marble",
    "forest",
    "planet",
    "velvet",
    "bridge",
    "summer",
    "ticket",
    "rocket",
    "island",
    "pepper",
    "window",
    "castle",
    "thunder",
    "meadow",
    "paper",
    "orbit",
    "coffee",
    "lantern",
    "mirror",
    "canyon",
    "safari",
    "piano",
    "market",
    "comet",
    "desert",
    "temple",
    "sailor",
    "cactus",
    "amber",
    "falcon",
]


def make_noise(rng: np.random.Generator, h: int, w: int, cells: tuple[float, ...] = (120, 36, 11, 4)) -> np.ndarray:
    """Fractal noise, (H, W) float32, of about unit deviation: one smooth layer for each cell size in pixels."""
    total = np.zeros((h, w), np.float32)
    for cell in cells:
        grid = rng.standard_normal((int(h / cell) + 2, int(w / cell) + 2)).astype(np.float32)
        total += cv2.resize(grid, (w, h), interpolation=cv2.INTER_CUBIC)
    return total / np.sqrt(len(cells)).astype(np.float32)


def pick_color(
    rng: np.random.Generator,
    value: tuple[float, float] = (0.35, 0.9),
    saturation: tuple[float, float] = (0.15, 0.75),
) -> tuple[float, float, float]:
    """A random BGR colour in 0..255, of bounded brightness and saturation."""
    hsv = np.array([[[rng.uniform(0, 360), rng.uniform(*saturation), rng.uniform(*value)]]], np.float32)
    b, g, r = 255.0 * cv2.cvtColor(hsv, cv2.COLOR_HSV2BGR)[0, 0]
    return float(b), float(g), float(r)


def write_text(
    image: np.ndarray, text: str, corner: tuple[int, int], height: int, ink: tuple[float, float, float]
) -> None:
    """Draw text with its top left at `corner` (x, y), capitals `height` pixels tall."""
    thickness = max(1, round(height / 8))
    origin = (corner[0], corner[1] + height)
    cv2.putText(image, text, origin, cv2.FONT_HERSHEY_DUPLEX, height / 22, ink, thickness, cv2.LINE_AA)


def paint_wallpaper(rng: np.random.Generator, h: int, w: int) -> np.ndarray:
    """Stripes with flowers, no two of which have the same petals, colour and place."""
    base, stripe = pick_color(rng, (0.55, 0.75), (0.03, 0.2)), pick_color(rng, (0.5, 0.8), (0.05, 0.3))
    pitch = int(rng.integers(70, 110))
    edges = np.arange(w) + 4 * make_noise(rng, 1, w, (200, 60))[0]
    image = _make_canvas(h, w, base)
    image[:, (edges % pitch) < pitch * 0.45] = stripe
    inks = [pick_color(rng, (0.3, 0.75), (0.1, 0.5)) for _ in range(5)]
    for y in range(pitch // 2, h, pitch):
        for x in range(pitch // 2, w, pitch):
            at = rng.normal((x, y), pitch * 0.1)
            _draw_flower(image, rng, at, pitch * rng.uniform(0.15, 0.4), inks[rng.integers(5)])
    return _add_wear(rng, image, 0.05)


def paint_bricks(rng: np.random.Generator, h: int, w: int) -> np.ndarray:
    """Brick walls in running bond: each brick has its own shade, and a few another colour."""
    base, odd = _pick_wood_color(rng) * (0.95, 0.85, 1), np.array(pick_color(rng))
    image = _make_canvas(h, w, pick_color(rng, (0.6, 0.8), (0.0, 0.15)))
    height, length = int(rng.integers(22, 34)), int(rng.integers(60, 90))
    for row, y in enumerate(range(0, h, height)):
        x = -length // 2 * (row % 2)
        while x < w:
            step = int(length * rng.uniform(0.8, 1.2))
            shade = (odd if rng.random() < 0.06 else base) * rng.normal(1, 0.17) + rng.normal(0, 7, 3)
            _fill_patch(image, x + 2, y + 2, x + step - 3, y + height - 3, shade)
            x += step
    return _add_wear(rng, image, 0.09)


def paint_planks(rng: np.random.Generator, h: int, w: int) -> np.ndarray:
    """Floor boards along x, each with its own tint, length and grain."""
    image = _make_canvas(h, w, (20.0, 25.0, 30.0))
    base, width = _pick_wood_color(rng), int(rng.integers(28, 46))
    for y in range(0, h, width):
        x = -int(rng.integers(0, 200))
        while x < w:
            length = int(rng.integers(150, 420))
            _fill_patch(image, x + 1, y + 1, x + length - 2, y + width - 2, base * rng.normal(1, 0.16))
            x += length
    image = shade_image(image, 1 + 0.13 * _make_grain(rng, h, w))
    for _ in range(h * w // 9000):
        x, y, r = rng.integers(0, w), rng.integers(0, h), int(rng.integers(2, 6))
        cv2.ellipse(image, (int(x), int(y)), (2 * r, r), 0, 0, 360, (base * 0.45).tolist(), -1, cv2.LINE_AA)
    return _add_wear(rng, image, 0.05)


def paint_tiles(rng: np.random.Generator, h: int, w: int) -> np.ndarray:
    """Square tiles, some with an ornament, no two of which are the same."""
    image = _make_canvas(h, w, pick_color(rng, (0.25, 0.4), (0.0, 0.2)))
    shades = [np.array(pick_color(rng, (0.4, 0.85), (0.05, 0.5))) for _ in range(3)]
    side = int(rng.integers(60, 90))
    for y in range(0, h, side):
        for x in range(0, w, side):
            shade = shades[rng.integers(3)] * rng.normal(1, 0.08)
            _fill_patch(image, x + 2, y + 2, x + side - 3, y + side - 3, shade)
            if rng.random() < 0.55:
                center = np.array([x + side / 2, y + side / 2])
                _draw_flower(image, rng, center, side * rng.uniform(0.2, 0.42), pick_color(rng))
    return _add_wear(rng, image, 0.08)


def paint_panels(rng: np.random.Generator, h: int, w: int) -> np.ndarray:
    """A suspended ceiling: pale perforated panels, and lamps."""
    image = _make_canvas(h, w, (185.0, 190.0, 190.0))
    side = int(rng.integers(120, 160))
    for y in range(0, h, side):
        for x in range(0, w, side):
            lamp = rng.random() < 0.15
            tone = 250.0 if lamp else rng.uniform(165, 225)
            _fill_patch(image, x + 3, y + 3, x + side - 4, y + side - 4, np.full(3, tone))
            if not lamp:
                dark = (tone * 0.6,) * 3
                for hole in rng.uniform((x + 8, y + 8), (x + side - 8, y + side - 8), (25, 2)):
                    cv2.circle(image, _round_point(hole), int(rng.integers(1, 5)), dark, -1, cv2.LINE_AA)
    return _add_wear(rng, image, 0.04)


def paint_rug(rng: np.random.Generator, h: int, w: int) -> np.ndarray:
    """Diamonds and flowers inside several borders."""
    image = _make_canvas(h, w, pick_color(rng, (0.3, 0.6)))
    for inset in np.cumsum(rng.integers(6, 16, 5)):
        cv2.rectangle(image, (inset, inset), (w - inset, h - inset), pick_color(rng), int(rng.integers(2, 7)))
    inks = [pick_color(rng) for _ in range(4)]
    for _ in range(h * w // 1500):
        at, r = rng.uniform((60, 60), (w - 60, h - 60)), rng.uniform(6, 22)
        if rng.random() < 0.5:
            _draw_flower(image, rng, at, r, inks[rng.integers(4)])
        else:
            diamond = at + r * np.array([(0, -1), (0.7, 0), (0, 1), (-0.7, 0)])
            cv2.fillPoly(image, [diamond.astype(np.int32)], inks[rng.integers(4)], cv2.LINE_AA)
    return _add_wear(rng, image, 0.1)


def paint_bookshelf(rng: np.random.Generator, h: int, w: int) -> np.ndarray:
    """Shelves of books with banded, lettered spines."""
    wood = _pick_wood_color(rng)
    image = _make_canvas(h, w, wood * 0.35)
    shelves = max(1, round(h / 85))
    for top, bottom in zip(*_divide_length(h, shelves), strict=True):
        x = 6
        while x < w - 14:
            width, height = int(rng.integers(7, 22)), int((bottom - top - 8) * rng.uniform(0.6, 0.97))
            if rng.random() < 0.93:
                ink, y = pick_color(rng, (0.2, 0.95), (0.1, 0.9)), bottom - height
                cv2.rectangle(image, (x, y), (min(x + width, w - 7), bottom), ink, -1)
                for band in rng.integers(y + 3, bottom - 2, 3):
                    cv2.line(image, (x + 1, int(band)), (x + width - 2, int(band)), pick_color(rng), 2)
            x += width + 1
        cv2.rectangle(image, (0, bottom), (w, bottom + 7), (wood * rng.normal(1, 0.05)).tolist(), -1)
    cv2.rectangle(image, (0, 0), (w - 1, h - 1), wood.tolist(), 10)
    return _add_wear(rng, image, 0.06)


def paint_drawers(rng: np.random.Generator, h: int, w: int) -> np.ndarray:
    """A wooden or painted front: drawers, knobs, and labels."""
    body = _pick_wood_color(rng) if rng.random() < 0.6 else np.array(pick_color(rng))
    image = _make_canvas(h, w, body * 0.45)
    for y0, y1 in zip(*_divide_length(h, max(1, round(h / 70))), strict=True):
        for x0, x1 in zip(*_divide_length(w, max(1, round(w / rng.uniform(90, 200)))), strict=True):
            _fill_patch(image, x0 + 4, y0 + 4, x1 - 2, y1 - 2, body * rng.normal(1, 0.1))
            knob = (int((x0 + x1) / 2 + rng.normal(0, 4)), int(y0 * 0.6 + y1 * 0.4))
            cv2.circle(image, knob, int(rng.integers(4, 8)), pick_color(rng, (0.1, 0.9)), -1, cv2.LINE_AA)
            if rng.random() < 0.6:
                write_text(image, f"{rng.integers(10, 999)}", (x0 + 10, y1 - 24), 11, pick_color(rng, (0.05, 0.25)))
    return _add_wear(rng, shade_image(image, 1 + 0.1 * _make_grain(rng, h, w)), 0.06)


def paint_carton(rng: np.random.Generator, h: int, w: int) -> np.ndarray:
    """A cardboard box: tape, a printed name, a number, and a label."""
    image = _make_canvas(h, w, np.array([110, 150, 185]) * rng.normal(1, 0.12))
    tape, thick = int(w * rng.uniform(0.3, 0.7)), int(rng.integers(8, 16))
    image[:, tape : tape + thick] = pick_color(rng, (0.6, 0.9), (0.1, 0.4))
    ink = pick_color(rng, (0.1, 0.35))
    write_text(image, str(rng.choice(WORDS)).upper(), (8, int(h * 0.12)), max(8, min(h, w) // 7), ink)
    write_text(image, f"{rng.integers(1, 99)}", (int(w * 0.1), int(h * 0.45)), max(10, h // 4), ink)
    x0, y0 = int(w * rng.uniform(0.45, 0.6)), int(h * rng.uniform(0.35, 0.55))
    cv2.rectangle(image, (x0, y0), (int(w * 0.93), int(h * 0.9)), (235, 238, 240), -1)
    for x in range(x0 + 4, int(w * 0.9), 4):
        cv2.line(image, (x, y0 + 4), (x, int(h * 0.75)), (30, 30, 30), int(rng.integers(1, 3)))
    return _add_wear(rng, image, 0.08)


def shade_image(image: np.ndarray, factor: np.ndarray) -> np.ndarray:
    """Multiply an image by (H, W) or (H, W, 3) factors; clip to uint8."""
    return np.clip(image * (factor[..., None] if factor.ndim == 2 else factor), 0, 255).astype(np.uint8)


def _make_canvas(h: int, w: int, fill: np.ndarray | tuple[float, float, float]) -> np.ndarray:
    """An image of one BGR colour."""
    return np.full((h, w, 3), np.clip(fill, 0, 255), np.uint8)


def _fill_patch(image: np.ndarray, x0: int, y0: int, x1: int, y1: int, tone: np.ndarray) -> None:
    """Fill a rectangle, its corners included."""
    cv2.rectangle(image, (x0, y0), (x1, y1), tone.tolist(), -1)


def _add_wear(rng: np.random.Generator, image: np.ndarray, amount: float) -> np.ndarray:
    """Add stains and fractal shading."""
    h, w = image.shape[:2]
    for _ in range(h * w // 5000):
        x, y = int(rng.integers(0, w)), int(rng.integers(0, h))
        tone = (image[y, x] * rng.uniform(0.6, 1.3)).tolist()
        axes = (int(rng.integers(1, 6)), int(rng.integers(1, 4)))
        cv2.ellipse(image, (x, y), axes, float(rng.uniform(0, 180)), 0, 360, tone, -1, cv2.LINE_AA)
    return shade_image(image, 1 + amount * make_noise(rng, h, w, (90, 25, 8, 3)))


def _draw_flower(image: np.ndarray, rng: np.random.Generator, at: np.ndarray, r: float, ink: tuple) -> None:
    """Draw a closed curve with a random number of petals, and a centre of another colour."""
    angle = np.linspace(0, 2 * np.pi, 48, endpoint=False)
    petals, phase, depth = rng.integers(3, 9), rng.uniform(0, 6.3), rng.uniform(0.15, 0.6)
    radius = r * (1 - depth * np.cos(petals * angle + phase) ** 2)
    curve = at + radius[:, None] * np.stack([np.cos(angle), np.sin(angle)], 1)
    cv2.fillPoly(image, [curve.astype(np.int32)], ink, cv2.LINE_AA)
    cv2.circle(image, _round_point(at), max(1, int(r * rng.uniform(0.15, 0.35))), pick_color(rng), -1, cv2.LINE_AA)


def _make_grain(rng: np.random.Generator, h: int, w: int) -> np.ndarray:
    """Noise stretched along x."""
    return cv2.resize(make_noise(rng, h, max(w // 24, 2), (9, 3)), (w, h), interpolation=cv2.INTER_CUBIC)


def _pick_wood_color(rng: np.random.Generator) -> np.ndarray:
    """A random brown, BGR, (3,)."""
    return rng.uniform((45, 85, 130), (90, 135, 190)) * rng.uniform(0.7, 1.15)


def _divide_length(length: int, parts: int) -> tuple[list[int], list[int]]:
    """Starts and ends of `parts` equal pieces, with a gap of 8 pixels after each."""
    edges = np.linspace(4, length - 4, parts + 1).astype(int).tolist()
    return edges[:-1], [edge - 8 for edge in edges[1:]]


def _round_point(at: np.ndarray) -> tuple[int, int]:
    """A point's coordinates as OpenCV needs them."""
    return int(at[0]), int(at[1])
