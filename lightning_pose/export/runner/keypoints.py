"""Keypoints with descriptors, as the package's local extractors find them, in numpy and OpenCV."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np

from lightning_pose.errors import ConfigError
from lightning_pose.features.surf.numpy_surf import extract_surf
from lightning_pose.geometry.camera import Camera
from lightning_pose.mapping.frames import MapQuery

__all__ = ["KeypointSettings", "Keypoints", "extract_keypoints", "make_query", "make_rows"]

MIN_STORED_FEATURES = 300
"""At least this many keypoints are extracted, of which the strongest are used."""

SMALLEST_SIDE = 8
"""Smaller images have no keypoints."""


@dataclass(frozen=True)
class KeypointSettings:
    """An extractor: `SURF`, `SIFT`, `ORB`, `AKAZE`, `FREAK` or `BRIEF`, keypoints to keep, and options."""

    name: str
    n_features: int
    columns: int
    with_geometry: bool = True
    upright: bool = True
    threshold: float = 0.0

    def extracts_as(self, other: KeypointSettings) -> bool:
        """Whether the keypoints of both are the same, or the first of the same."""
        ours, theirs = (replace(each, n_features=0, with_geometry=False) for each in (self, other))
        most = max(MIN_STORED_FEATURES, other.n_features)
        return (
            ours == theirs and max(MIN_STORED_FEATURES, self.n_features) == most and other.n_features <= self.n_features
        )


@dataclass(frozen=True)
class Keypoints:
    """Keypoints of one image, strongest first.

    Attributes:
        geometry: (K, 5) float32: x, y, size (pixels), response, angle (degrees).
        descriptors: (K, D) float32, unit length.
        size: width and height of the image.
    """

    geometry: np.ndarray
    descriptors: np.ndarray
    size: tuple[int, int]


def extract_keypoints(gray: np.ndarray, settings: KeypointSettings) -> Keypoints:
    """Find and describe the keypoints of a (H, W) uint8 image."""
    n = max(settings.n_features, MIN_STORED_FEATURES)
    if settings.name == "SURF":
        geometry, descriptors = extract_surf(gray, n, settings.upright, settings.threshold)
    else:
        geometry, descriptors = extract_with_opencv(gray, n, settings)
    n = settings.n_features
    return Keypoints(geometry[:n], descriptors[:n], (gray.shape[1], gray.shape[0]))


def extract_with_opencv(gray: np.ndarray, n: int, settings: KeypointSettings) -> tuple[np.ndarray, np.ndarray]:
    """As `extract_surf`, by OpenCV's extractor of this name; binary descriptors get a column of -1 or +1 a bit."""
    detector, describer = make_opencv_extractor(n, settings)
    found, raw = ((), None)
    if min(gray.shape) >= SMALLEST_SIDE:
        if detector is None:
            found, raw = describer.detectAndCompute(gray, None)
        else:
            found, raw = describer.compute(gray, detector.detect(gray))
    if raw is None or not len(found):
        return np.zeros((0, 5), np.float32), np.zeros((0, settings.columns), np.float32)
    rows = np.array([(*k.pt, k.size, k.response, k.angle) for k in found], np.float32)
    rows[:, 4] = np.where(rows[:, 4] == -1, 0, rows[:, 4] % 360)  # OpenCV's -1: no angle
    x, y, size, response, angle = rows.T
    order = np.lexsort((angle, size, x, y, -response))[:n]
    raw = raw[order]
    if raw.dtype == np.uint8:
        raw = np.unpackbits(raw.astype(np.uint8), axis=1, count=settings.columns) * np.float32(2) - 1
    norms = np.linalg.norm(raw, axis=1, keepdims=True)
    return rows[order], raw / np.maximum(norms, np.finfo(np.float32).tiny)


def make_opencv_extractor(n: int, settings: KeypointSettings) -> tuple[cv2.FastFeatureDetector | None, cv2.Feature2D]:
    """A detector, None where the second finds its keypoints itself, and what describes keypoints."""
    if settings.name == "SIFT":
        return None, cv2.SIFT.create(n, contrastThreshold=settings.threshold)
    if settings.name == "ORB":
        return None, cv2.ORB.create(n, fastThreshold=round(settings.threshold))
    contrib = getattr(cv2, "xfeatures2d", None)
    if contrib is None:
        raise ConfigError(
            f"this OpenCV has no {settings.name}; install opencv-contrib-python-headless in place of "
            "opencv-python-headless"
        )
    if settings.name == "AKAZE":
        return None, contrib.AKAZE.create(threshold=settings.threshold)
    describer = contrib.FREAK.create() if settings.name == "FREAK" else contrib.BriefDescriptorExtractor.create(32)
    return cv2.FastFeatureDetector.create(round(settings.threshold)), describer


def make_rows(found: Keypoints, settings: KeypointSettings) -> np.ndarray:
    """(N, D) float32 for a network, or (N, D + 4) with place, size and response; rows of zeros at the end."""
    geometry, descriptors = found.geometry[: settings.n_features], found.descriptors[: settings.n_features]
    rows = np.zeros((settings.n_features, settings.columns + 4 * settings.with_geometry), np.float32)
    count = len(geometry)
    rows[:count, : settings.columns] = descriptors
    if settings.with_geometry and count:
        x, y, size, response = geometry[:, :4].T
        half_w, half_h = np.maximum(np.array(found.size) / 2, 0.5)
        strongest = max(float(response[0]), np.finfo(np.float32).tiny)
        rows[:count, settings.columns] = x / half_w - 1
        rows[:count, settings.columns + 1] = y / half_h - 1
        rows[:count, settings.columns + 2] = np.log2(np.maximum(size, 1.0) / 16)
        rows[:count, settings.columns + 3] = np.log10(np.maximum(response / strongest, 1e-6)) / 2
    return rows


def make_query(found: Keypoints, camera: Camera) -> MapQuery:
    """Keypoints as a map reads them; `camera` is for this image as it is."""
    columns = found.descriptors.shape[1]
    rows = make_rows(found, KeypointSettings("", len(found.descriptors), columns))
    rows = rows[(rows[:, :columns] != 0).any(axis=1)]
    x, y, log_size = rows[:, columns : columns + 3].astype(np.float64).T  # rounded, as those that the map is made of
    pixels = np.stack([(x + 1) * camera.width / 2, (y + 1) * camera.height / 2], axis=-1)
    return MapQuery(
        points=camera.normalize(pixels),
        size_px=(16 * 2**log_size).astype(np.float32),
        descriptors=np.ascontiguousarray(rows[:, :columns]),
        focal_px=camera.focal_px,
        half_view=camera.half_view,
    )
