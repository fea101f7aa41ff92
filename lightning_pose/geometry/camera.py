"""Cameras: from pixels to normalised image coordinates, distortion removed."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float

from lightning_pose.errors import ConfigError
from lightning_pose.geometry.lenses import LENS_PARAMETERS, distort_points, undistort_points

__all__ = ["CAMERA_MODELS", "Camera"]

CAMERA_MODELS = {
    "SIMPLE_PINHOLE": "f cx cy",
    "PINHOLE": "fx fy cx cy",
    "SIMPLE_RADIAL": "f cx cy k1",
    "RADIAL": "f cx cy k1 k2",
    "OPENCV": "fx fy cx cy k1 k2 p1 p2",
    "FULL_OPENCV": "fx fy cx cy k1 k2 p1 p2 k3 k4 k5 k6",
    "SIMPLE_FISHEYE": "f cx cy",
    "FISHEYE": "fx fy cx cy",
    "SIMPLE_RADIAL_FISHEYE": "f cx cy k1",
    "RADIAL_FISHEYE": "f cx cy k1 k2",
    "OPENCV_FISHEYE": "fx fy cx cy k1 k2 k3 k4",
} | {model: " ".join(["fx fy cx cy", *names]) for model, names in LENS_PARAMETERS.items()}
"""COLMAP's camera models that are read, and the names of their parameters in order."""

MAX_SIDE = 100_000
"""Pixels of the widest image of a camera."""

MAX_SHOWN = 200
"""Characters of a camera in a message."""

ITERATIONS = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 100, 1e-12)
"""When the search for an undistorted point ends."""


@dataclass(frozen=True)
class Camera:
    """A camera with lens distortion as OpenCV or COLMAP models it.

    Pixel coordinates have the centre of the first pixel at (0, 0), as OpenCV and TUM's calibrations do. COLMAP's files
    have its corner there: 0.5 is to be taken from their principal points.

    Attributes:
        width: of the images that the other numbers are for, in pixels.
        height: the same.
        fx: focal length across, in pixels.
        fy: focal length down.
        cx: principal point.
        cy: principal point.
        distortion: k1 k2 p1 p2 k3 k4 k5 k6, or with `fisheye` k1 k2 k3 k4, or the coefficients of `LENS_PARAMETERS`,
            whose number says which lens it is; empty for none.
        fisheye: whether the distortion is that of a fisheye lens (equidistant).

    >>> camera = Camera.parse("PINHOLE,640,480,500,500,320,240")
    >>> camera.normalize(np.array([[420.0, 240.0]])).tolist()
    [[0.2, 0.0]]
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    distortion: tuple[float, ...] = ()
    fisheye: bool = False

    @classmethod
    def parse(cls, text: str) -> Camera:
        """A camera in COLMAP's notation: `MODEL,WIDTH,HEIGHT,PARAMETERS...`.

        Raises:
            ConfigError: the model is unknown, or numbers are missing, superfluous or impossible.

        >>> Camera.parse("SIMPLE_RADIAL,640,480,500,320,240,0.1").distortion
        (0.1, 0.0, 0.0, 0.0)
        """
        shown = text if len(text) <= MAX_SHOWN else f"{text[:MAX_SHOWN]}..."  # it may come from a stranger
        name, *numbers = (part.strip() for part in text.split(","))
        name = name.upper()
        if name not in CAMERA_MODELS:
            raise ConfigError(
                f"camera {shown!r}: {name[:20]!r} is no camera model; give one of {', '.join(CAMERA_MODELS)}"
            )
        names = CAMERA_MODELS[name].split()
        form = f"{name},WIDTH,HEIGHT,{','.join(names).upper()}"
        try:
            width, height, *values = (float(number) for number in numbers)
            found = dict(zip(names, values, strict=True))
        except ValueError:
            raise ConfigError(f"camera {shown!r} does not have the form {form}") from None
        fx, fy = found.get("fx", found.get("f", 0.0)), found.get("fy", found.get("f", 0.0))
        if not all(np.isfinite([width, height, *values])) or min(width, height, fx, fy) <= 0:
            raise ConfigError(f"camera {shown!r}: width, height and focal lengths must be above 0 ({form})")
        if not (1 <= width <= MAX_SIDE and 1 <= height <= MAX_SIDE):
            raise ConfigError(f"camera {shown!r}: width and height must be 1 to {MAX_SIDE} ({form})")
        fisheye = name.endswith("FISHEYE") or name in LENS_PARAMETERS
        if name in LENS_PARAMETERS:
            lens = tuple(found[key] for key in LENS_PARAMETERS[name])
            return cls(int(width), int(height), fx, fy, found["cx"], found["cy"], lens, fisheye)
        order = ("k1", "k2", "k3", "k4") if fisheye else ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
        distortion = tuple(found.get(key, 0.0) for key in order) if fisheye or "k1" in found else ()
        if not fisheye and "k3" not in found:
            distortion = distortion[:4]
        return cls(int(width), int(height), fx, fy, found["cx"], found["cy"], distortion, fisheye)

    def __str__(self) -> str:
        """COLMAP's notation, as `parse` reads it.

        >>> print(Camera.parse("SIMPLE_RADIAL,640,480,500,320,240,0.1"))
        OPENCV,640,480,500,500,320,240,0.1,0,0,0
        """
        name = self.lens or "OPENCV_FISHEYE" if self.fisheye else "PINHOLE" if not self.distortion else "FULL_OPENCV"
        name = "OPENCV" if name == "FULL_OPENCV" and not any(self.distortion[4:]) else name
        count = len(CAMERA_MODELS[name].split()) - 4
        distortion = (*self.distortion, *[0.0] * count)[:count]
        numbers = (self.width, self.height, self.fx, self.fy, self.cx, self.cy, *distortion)
        return ",".join([name, *(f"{number:.10g}" for number in numbers)])

    @property
    def lens(self) -> str:
        """The name in `LENS_PARAMETERS` of a lens that OpenCV does not have; empty for others."""
        return next(
            (n for n, names in LENS_PARAMETERS.items() if self.fisheye and len(names) == len(self.distortion)), ""
        )

    @property
    def focal_px(self) -> float:
        """The mean focal length, for thresholds in pixels."""
        return (self.fx + self.fy) / 2

    @property
    def half_view(self) -> np.ndarray:
        """(2,) half the width and height of the image in normalised image coordinates, without distortion."""
        return np.array([self.width / self.fx, self.height / self.fy]) / 2

    def resize(self, width: int, height: int) -> Camera:
        """The same camera with its images scaled to another size."""
        x, y = width / self.width, height / self.height
        return Camera(
            width,
            height,
            self.fx * x,
            self.fy * y,
            (self.cx + 0.5) * x - 0.5,
            (self.cy + 0.5) * y - 0.5,
            self.distortion,
            self.fisheye,
        )

    def normalize(self, pixels: Float[np.ndarray, "*batch 2"]) -> Float[np.ndarray, "*batch 2"]:
        """Normalised image coordinates of pixels: x and y of the ray at depth 1."""
        if not self.distortion:
            return (pixels - [self.cx, self.cy]) / [self.fx, self.fy]
        if self.lens:
            distorted = (pixels.reshape(-1, 2) - [self.cx, self.cy]) / [self.fx, self.fy]
            return undistort_points(distorted, self.distortion).reshape(pixels.shape)
        flat = np.ascontiguousarray(pixels.reshape(-1, 1, 2), dtype=np.float64)
        if not len(flat):
            return np.zeros_like(pixels, dtype=np.float64)
        matrix = np.array([[self.fx, 0, self.cx], [0, self.fy, self.cy], [0, 0, 1.0]])
        coefficients = np.array(self.distortion)
        if self.fisheye:
            found = cv2.fisheye.undistortPoints(flat, matrix, coefficients, criteria=ITERATIONS)
        else:
            found = cv2.undistortPoints(flat, matrix, coefficients, criteria=ITERATIONS)
        return found.reshape(pixels.shape)

    def project(self, points: Float[np.ndarray, "*batch 2"]) -> Float[np.ndarray, "*batch 2"]:
        """Pixels of normalised image coordinates: the inverse of `normalize`."""
        matrix = np.array([[self.fx, 0, self.cx], [0, self.fy, self.cy], [0, 0, 1.0]])
        if not self.distortion or not points.size:
            return points * [self.fx, self.fy] + [self.cx, self.cy]
        if self.lens:
            distorted = distort_points(points.reshape(-1, 2), self.distortion)
            return (distorted * [self.fx, self.fy] + [self.cx, self.cy]).reshape(points.shape)
        flat, nowhere, coefficients = (
            points.reshape(-1, 1, 2).astype(np.float64),
            np.zeros(3),
            np.array(self.distortion),
        )
        if self.fisheye:
            pixels = cv2.fisheye.distortPoints(flat, matrix, coefficients)
        else:
            pixels = cv2.projectPoints(cv2.convertPointsToHomogeneous(flat), nowhere, nowhere, matrix, coefficients)[0]
        return pixels.reshape(points.shape)
