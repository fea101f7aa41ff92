"""The renderer: images of textured rectangles from a pinhole camera, with a depth buffer and mip maps."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from lightning_pose.scenes.scene import Intrinsics
from lightning_pose.scenes.synthetic.room import Quad

__all__ = ["SUBSAMPLES", "Renderer", "make_camera"]

SUBSAMPLES = np.array([(-3, -1), (1, -3), (3, 1), (-1, 3)]) / 8
"""Offsets in pixels at which each pixel is sampled: a rotated grid."""

_ATLAS_WIDTH = 4096
_LEVELS = 7


def make_camera(size: tuple[int, int]) -> Intrinsics:
    """Intrinsics for images of a width and height: 63 degrees of horizontal view, as in 7-Scenes.

    Pixel centres have integer coordinates.
    """
    width, height = size
    focal = 525 / 640 * width
    return Intrinsics(focal, focal, (width - 1) / 2, (height - 1) / 2)


class Renderer:
    """Renders images of rectangles.

    A rectangle's points are c + s*u + t*v. With M = R^T [u, v, c - camera] and a pixel's ray d,
    M (s, t, 1) = z * d, so M^-1 d = (s, t, 1) / z. These three affine functions of the pixel give the inverse depth,
    and whether the pixel lies inside the rectangle; nothing has to be clipped.

    Args:
        quads: all rectangles. A pixel without any gets the colour of the first one's nearest point.
        camera: the intrinsics.
        size: width and height of the images, in pixels.
    """

    def __init__(self, quads: Sequence[Quad], camera: Intrinsics, size: tuple[int, int]) -> None:
        self._camera, self._size = camera, size
        self._corners = np.array([q.corner for q in quads])
        self._edges = np.stack([[q.u for q in quads], [q.v for q in quads]], axis=-1)
        self._atlas, self._places = _pack_atlas([_build_pyramid(q.texture) for q in quads])

    def render(self, T_world_cam: np.ndarray) -> np.ndarray:
        """Render one image.

        Args:
            T_world_cam: (4, 4, 4) camera-to-world poses at four moments while the shutter is open, or (4, 4) of a
                camera at rest; x right, y down, z forward.

        Returns:
            (H, W, 3) float32 BGR in 0..255, free of noise.
        """
        poses = np.broadcast_to(T_world_cam, (len(SUBSAMPLES), 4, 4))
        total = np.zeros((self._size[1], self._size[0], 3), np.float32)
        for k, (pose, offset) in enumerate(zip(poses, SUBSAMPLES, strict=True)):
            # Each subsample rounds its mip level at another value, so that their mean is a blend of levels.
            cv2.accumulate(self._sample(pose, offset, (k - 1.5) / 4), total)
        return total / len(SUBSAMPLES)

    def _sample(self, pose: np.ndarray, offset: np.ndarray, dither: float) -> np.ndarray:
        """(H, W, 3) uint8: one ray per pixel, at `offset` from its centre."""
        width, height = self._size
        x = ((np.arange(width) + offset[0] - self._camera.cx) / self._camera.fx).astype(np.float32)
        y = ((np.arange(height) + offset[1] - self._camera.cy) / self._camera.fy).astype(np.float32)
        rotation, center = pose[:3, :3], pose[:3, 3]
        M = rotation.T @ np.concatenate([self._edges, (self._corners - center)[..., None]], axis=-1)
        # Positive if the camera is on the visible side; near zero if it is in the plane of the rectangle.
        facing = np.linalg.det(M)
        windows = _find_windows(M, x, y)
        visible = np.flatnonzero((facing > 1e-6) & (windows[:, ::2] < windows[:, 1::2]).all(1))
        inverses = np.zeros_like(M)
        inverses[visible] = np.linalg.inv(M[visible])

        nearest, owner = np.zeros((height, width), np.float32), np.zeros((height, width), np.intp)
        for q in visible:
            top, bottom, left, right = windows[q]
            window = slice(top, bottom), slice(left, right)
            s, t, inv_z = _evaluate_affine(inverses[q], x[window[1]], y[window[0]])
            slack = 1e-4 * inv_z  # closes gaps between adjoining rectangles, which rounding errors cause
            wins = (inv_z > nearest[window]) & (s >= -slack) & (t >= -slack)
            wins &= (s <= inv_z + slack) & (t <= inv_z + slack)
            np.copyto(nearest[window], inv_z, where=wins)
            owner[window][wins] = q
        return self._shade(owner, inverses.astype(np.float32), 1 / np.maximum(facing, 1e-6), x, y, dither)

    def _shade(
        self,
        owner: np.ndarray,
        inverses: np.ndarray,
        density: np.ndarray,
        x: np.ndarray,
        y: np.ndarray,
        dither: float,
    ) -> np.ndarray:
        """Colours (H, W, 3) uint8 of all pixels, from the texture level whose texels are about a pixel wide.

        The map (s, t) of pixels has the Jacobian determinant det(M^-1) z^3 / f^2 (a homography's).
        """
        rows = inverses.reshape(len(inverses), 9).T
        s, t, inv_z = (rows[i][owner] * x + rows[i + 1][owner] * y[:, None] + rows[i + 2][owner] for i in (0, 3, 6))
        inv_z = np.maximum(inv_z, 1e-3)
        texels = self._places[:, 0, 2] * self._places[:, 0, 3] * density / (self._camera.fx * self._camera.fy)
        lod = (0.5 * np.log2(texels)).astype(np.float32)[owner] - 1.5 * np.log2(inv_z)
        level = np.clip(np.rint(lod + dither), 0, _LEVELS - 1).astype(np.intp)
        left, top, w, h = self._places.reshape(-1, 4).T[:, owner * _LEVELS + level]
        map_x = left + np.clip(s / inv_z * w - 0.5, 0, w - 1)
        map_y = top + np.clip(t / inv_z * h - 0.5, 0, h - 1)
        return cv2.remap(self._atlas, map_x, map_y, cv2.INTER_LINEAR)


def _find_windows(M: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """The rows and columns of pixels that each rectangle can cover.

    Returns:
        (Q, 4): first row, last row + 1, first column, last column + 1. They are all rows and columns if the rectangle
        is partly behind the camera, none if it is wholly behind.
    """
    corners = M @ np.array([(0, 1, 1, 0), (0, 0, 1, 1), (1, 1, 1, 1)])
    crosses, behind = corners[:, 2].min(1) < 0.01, corners[:, 2].max(1) < 0.01
    with np.errstate(divide="ignore", invalid="ignore"):
        projected = corners[:, :2] / corners[:, 2:]
    edges = []
    for rays, along in ((y, projected[:, 1]), (x, projected[:, 0])):
        low = np.where(crosses, -np.inf, along.min(1) - 1e-3)
        high = np.where(crosses, np.inf, along.max(1) + 1e-3)
        edges += [np.searchsorted(rays, low), np.searchsorted(rays, np.where(behind, -np.inf, high))]
    return np.stack(edges, axis=1)


def _evaluate_affine(inverse: np.ndarray, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, ...]:
    """The three components of M^-1 (x, y, 1), each (len(y), len(x)), over a grid of rays."""
    a = inverse.astype(np.float32)
    return tuple(a[i, 0] * x + (a[i, 1] * y + a[i, 2])[:, None] for i in range(3))


def _build_pyramid(texture: np.ndarray) -> list[np.ndarray]:
    """The texture in _LEVELS sizes, each half as wide and high as the one before."""
    levels = [texture]
    for _ in range(_LEVELS - 1):
        h, w = levels[-1].shape[:2]
        levels.append(cv2.resize(levels[-1], (max(w // 2, 1), max(h // 2, 1)), interpolation=cv2.INTER_AREA))
    return levels


def _pack_atlas(pyramids: list[list[np.ndarray]]) -> tuple[np.ndarray, np.ndarray]:
    """Place every level of every texture in one image: in rows from left to right, the highest first.

    Returns:
        the atlas, and (Q, _LEVELS, 4) float32: left, top, width and height of each level.
    """
    sizes = np.array([[level.shape[1::-1] for level in pyramid] for pyramid in pyramids]).reshape(-1, 2)
    corners = np.zeros_like(sizes)
    x = y = shelf = 0
    for i in np.argsort(-sizes[:, 1], kind="stable"):
        if x + sizes[i, 0] > _ATLAS_WIDTH:
            x, y, shelf = 0, y + shelf, 0
        corners[i] = x, y
        x, shelf = x + sizes[i, 0], max(shelf, sizes[i, 1])
    atlas = np.zeros((y + shelf, _ATLAS_WIDTH, 3), np.uint8)
    levels = [level for pyramid in pyramids for level in pyramid]
    for (left, top), (w, h), level in zip(corners, sizes, levels, strict=True):
        atlas[top : top + h, left : left + w] = level
    places = np.concatenate([corners, sizes], axis=1).astype(np.float32)
    return atlas, places.reshape(len(pyramids), _LEVELS, 4)
