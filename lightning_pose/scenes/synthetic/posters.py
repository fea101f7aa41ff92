"""Images of the pictures on the walls of the synthetic room: signs, paintings, maps, windows and clocks.

Every function takes a random generator and a size in pixels and returns an (H, W, 3) uint8 BGR image.
"""

from __future__ import annotations

import cv2
import numpy as np

from lightning_pose.scenes.synthetic.textures import WORDS, make_noise, pick_color, shade_image, write_text

__all__ = ["paint_poster"]


def paint_poster(rng: np.random.Generator, h: int, w: int) -> np.ndarray:
    """A random kind of picture in a frame."""
    kinds = (_paint_sign, _paint_sign, _paint_shapes, _paint_map, _paint_landscape, _paint_window, _paint_clock)
    image = kinds[rng.integers(len(kinds))](rng, h, w)
    cv2.rectangle(image, (0, 0), (w - 1, h - 1), pick_color(rng, (0.1, 0.9)), int(rng.integers(4, 14)))
    return image


def _paint_paper(rng: np.random.Generator, h: int, w: int) -> np.ndarray:
    """A pale background with slight noise."""
    image = np.full((h, w, 3), pick_color(rng, (0.75, 1.0), (0.0, 0.5)), np.uint8)
    return shade_image(image, 1 + 0.03 * make_noise(rng, h, w))


def _paint_sign(rng: np.random.Generator, h: int, w: int) -> np.ndarray:
    """A headline, a big number, and a paragraph."""
    image, size = _paint_paper(rng, h, w), max(10, min(h, w) // 9)
    if rng.random() < 0.5:
        image[: h // 3] = pick_color(rng)
    write_text(image, str(rng.choice(WORDS)).upper(), (14, size), size, pick_color(rng, (0.05, 0.3)))
    write_text(image, f"{rng.integers(0, 1000)}", (14, int(2.6 * size)), int(2.4 * size), pick_color(rng, (0.1, 0.7)))
    ink = pick_color(rng, (0.05, 0.3))
    for y in range(int(5.8 * size), h - 16, 17):
        letters = max(3, int((w - 28) / 9 * rng.uniform(0.6, 1)))
        write_text(image, " ".join(rng.choice(WORDS, 8))[:letters], (14, y), 9, ink)
    return image


def _paint_shapes(rng: np.random.Generator, h: int, w: int) -> np.ndarray:
    """Overlapping discs, bars, rings and triangles."""
    image = _paint_paper(rng, h, w)
    for _ in range(int(rng.integers(18, 34))):
        x, y = int(rng.integers(0, w)), int(rng.integers(0, h))
        r = int(rng.uniform(0.03, 0.17) * min(h, w)) + 2
        ink, kind = pick_color(rng, (0.1, 1.0), (0.2, 1.0)), rng.integers(4)
        if kind == 0:
            cv2.circle(image, (x, y), r, ink, -1, cv2.LINE_AA)
        elif kind == 1:
            cv2.circle(image, (x, y), r, ink, max(2, r // 4), cv2.LINE_AA)
        elif kind == 2:
            bar = cv2.boxPoints(((x, y), (2 * r, 0.7 * r), float(rng.uniform(0, 180))))
            cv2.fillPoly(image, [bar.astype(np.int32)], ink, cv2.LINE_AA)
        else:
            corners = rng.normal((x, y), r, (3, 2)).astype(np.int32)
            cv2.fillPoly(image, [corners], ink, cv2.LINE_AA)
    return image


def _paint_map(rng: np.random.Generator, h: int, w: int) -> np.ndarray:
    """Coloured districts around random towns, with roads and names."""
    towns = rng.uniform((0, 0), (w, h), (int(rng.integers(25, 60)), 2)).astype(np.int32)
    seeds = np.full((h, w), 255, np.uint8)
    seeds[towns[:, 1], towns[:, 0]] = 0
    labels = np.asarray(cv2.distanceTransformWithLabels(seeds, cv2.DIST_L2, 5)[1], np.intp)
    inks = np.array([pick_color(rng, (0.5, 1.0), (0.15, 0.7)) for _ in range(labels.max() + 1)], np.float32)
    image = shade_image(inks[labels], 1 + 0.05 * make_noise(rng, h, w))
    cv2.polylines(image, [towns[:9]], False, pick_color(rng, (0.1, 0.4)), 3, cv2.LINE_AA)
    cv2.polylines(image, [towns[9:16]], False, pick_color(rng, (0.7, 1.0)), 2, cv2.LINE_AA)
    for x, y in towns[:12]:
        write_text(image, str(rng.choice(WORDS)), (int(x), int(y)), 8, (25, 25, 25))
    return image


def _paint_landscape(rng: np.random.Generator, h: int, w: int) -> np.ndarray:
    """Coloured bands of fractal noise, as of a landscape, with short brush strokes."""
    inks = np.array([pick_color(rng, (0.2, 1.0), (0.2, 0.9)) for _ in range(9)], np.uint8)
    field = make_noise(rng, h, w, (70, 70, 30, 14)) + np.linspace(-2, 2, h, dtype=np.float32)[:, None]
    image = inks[np.clip(((field + 3) * 1.5).astype(int), 0, 8)]
    for x, y in rng.uniform((0, 0), (w, h), (h * w // 900, 2)):
        end = (int(x + rng.normal(0, 9)), int(y + rng.normal(0, 9)))
        cv2.line(image, (int(x), int(y)), end, inks[rng.integers(9)].tolist(), 2, cv2.LINE_AA)
    return image


def _paint_window(rng: np.random.Generator, h: int, w: int) -> np.ndarray:
    """Sky over houses with lit windows, behind two bars."""
    sky = np.linspace(0, 1, h, dtype=np.float32)[:, None, None]
    zenith, horizon = np.array(pick_color(rng, (0.6, 0.9), (0.3, 0.6))), np.array(pick_color(rng, (0.8, 1.0)))
    image = shade_image((1 - sky) * zenith + sky * horizon, 1 + 0.08 * make_noise(rng, h, w, (90, 45, 20)))
    x = 0
    while x < w:
        width, top = int(rng.integers(14, 40)), int(h * rng.uniform(0.35, 0.85))
        cv2.rectangle(image, (x, top), (x + width, h), pick_color(rng, (0.15, 0.5), (0.05, 0.4)), -1)
        for lit in rng.uniform((x + 2, top + 3), (x + width - 3, h), (10, 2)).astype(int):
            cv2.rectangle(image, lit.tolist(), (lit + np.array([3, 4])).tolist(), (150, 230, 250), -1)
        x += width
    bar = (225, 228, 230)
    cv2.line(image, (w // 2, 0), (w // 2, h), bar, 8)
    cv2.line(image, (0, h // 2), (w, h // 2), bar, 8)
    return image


def _paint_clock(rng: np.random.Generator, h: int, w: int) -> np.ndarray:
    """A dial with twelve figures, two hands and a word, on a striped background."""
    image = _paint_paper(rng, h, w)
    for x in range(0, w, 24):
        stripe = pick_color(rng, (0.6, 0.9), (0.1, 0.4))
        cv2.rectangle(image, (x, 0), (x + int(rng.integers(5, 15)), h), stripe, -1)
    center, r = np.array([w / 2, h / 2]), 0.42 * min(h, w)
    cv2.circle(image, (w // 2, h // 2), int(r), pick_color(rng, (0.85, 1.0), (0.0, 0.3)), -1, cv2.LINE_AA)
    cv2.circle(image, (w // 2, h // 2), int(r), pick_color(rng, (0.1, 0.5)), 6, cv2.LINE_AA)
    for hour, angle in enumerate(np.arange(12) * np.pi / 6):
        x, y = center + 0.8 * r * np.array([np.sin(angle), -np.cos(angle)]) - 0.07 * r
        write_text(image, str(hour or 12), (int(x), int(y)), max(7, int(0.14 * r)), (20, 20, 20))
    for length, thick in ((0.5, 5), (0.7, 3)):
        angle = rng.uniform(0, 2 * np.pi)
        tip = center + length * r * np.array([np.sin(angle), -np.cos(angle)])
        cv2.line(image, (w // 2, h // 2), (int(tip[0]), int(tip[1])), (30, 30, 40), thick, cv2.LINE_AA)
    write_text(image, str(rng.choice(WORDS)), (int(w * 0.38), int(h * 0.6)), 9, pick_color(rng, (0.1, 0.5)))
    return image
