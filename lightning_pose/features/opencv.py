"""The features with which the thesis compares SURF (fig. 3.5), SIFT, ORB, FREAK and BRIEF, and AKAZE, by OpenCV."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Mapping, Sequence

import cv2
import numpy as np

from lightning_pose.features.base import LocalExtractor, Record

__all__ = ["AKAZE", "BRIEF", "FREAK", "ORB", "SIFT"]

Settings = Mapping[str, str | int | float | bool | None]
Describe = Callable[[np.ndarray], tuple[Sequence[cv2.KeyPoint], np.ndarray | None]]

_SMALLEST_SIDE = 8  # pixels; in smaller images ORB raises an error and the other detectors find nothing


class _OpenCVExtractor(LocalExtractor):
    """Base of extractors that sort OpenCV's keypoints, keep `n_stored` of them and normalise their descriptors.

    Rows are in descending order of response; equal responses (FAST's are integers) are ordered by y, x, size
    and angle, so that the order does not depend on OpenCV's threads. Angles are 0..360, 0 if unknown.

    Binary descriptors become one column per bit, -1 or +1 before normalising: the squared Euclidean
    distance of two rows is 4/D of their Hamming distance.
    """

    @property
    def settings(self) -> Settings:
        # Another OpenCV may find other features, so its version keys the cache too.
        return {"n_stored": self.n_stored, "opencv": cv2.__version__, **self._options()}

    def extract(self, images: Sequence[np.ndarray]) -> list[Record]:
        describe = self._describer()
        return [self._record(image, describe) for image in images]

    @abstractmethod
    def _options(self) -> Settings:
        """Settings of this kind of feature, besides those of all."""

    @abstractmethod
    def _describer(self) -> Describe:
        """Make a function from an image to keypoints and (n, bytes) uint8 or (n, D) float32 descriptors, or None.

        Called in each call of `extract`, because OpenCV's objects must not be shared between threads.
        """

    def _record(self, image: np.ndarray, describe: Describe) -> Record:
        """Describe one image, sort its keypoints, and fill up with zero rows."""
        keypoints = np.zeros((self.n_stored, 5), np.float32)
        descriptors = np.zeros((self.n_stored, self.descriptor_dim), np.float32)
        found, raw = describe(image) if min(image.shape) >= _SMALLEST_SIDE else ((), None)
        count = min(len(found), self.n_stored)
        if count and raw is not None:
            rows = np.array([(*k.pt, k.size, k.response, k.angle) for k in found], np.float32)
            rows[:, 4] = np.where(rows[:, 4] == -1, 0, rows[:, 4] % 360)  # OpenCV's -1: no angle
            x, y, size, response, angle = rows.T
            order = np.lexsort((angle, size, x, y, -response))[:count]
            keypoints[:count] = rows[order]
            descriptors[:count] = _normalise_rows(raw[order], self.descriptor_dim)
        return {
            "descriptors": descriptors,
            "keypoints": keypoints,
            "count": np.array(count, np.int64),
            "image_size": np.array(image.shape[::-1], np.int64),
        }


def _normalise_rows(raw: np.ndarray, columns: int) -> np.ndarray:
    """Unit rows (n, columns) float32 from rows of floats, or of packed bits, of which the last byte may be padded."""
    rows = np.unpackbits(raw, axis=1, count=columns) * np.float32(2) - 1 if raw.dtype == np.uint8 else raw
    norms = np.linalg.norm(rows, axis=1, keepdims=True)
    return rows / np.maximum(norms, np.finfo(np.float32).tiny)


class SIFT(_OpenCVExtractor):
    """Scale-invariant feature transform (Lowe 2004), 128 columns.

    Args:
        n_features: N, how many of the strongest features the networks read.
        with_geometry: append normalised x, y, log size and response.
        contrast_threshold: Lowe's; lower finds more features in plain images (OpenCV's default).
    """

    descriptor_dim = 128

    def __init__(self, n_features: int = 300, with_geometry: bool = False, contrast_threshold: float = 0.04) -> None:
        super().__init__(n_features, with_geometry)
        self.contrast_threshold = contrast_threshold

    def _options(self) -> Settings:
        return {"contrast_threshold": self.contrast_threshold}

    def _describer(self) -> Describe:
        sift = cv2.SIFT.create(self.n_stored, contrastThreshold=self.contrast_threshold)
        return lambda image: sift.detectAndCompute(image, None)


class ORB(_OpenCVExtractor):
    """Oriented FAST and rotated BRIEF (Rublee et al. 2011), 256 columns; the response is Harris's.

    Each level of its pyramid has a quota of the `n_stored` features, so with N above
    `MIN_STORED_FEATURES` other features may be the strongest.

    Args:
        n_features: N, how many of the strongest features the networks read.
        with_geometry: append normalised x, y, log size and response.
        fast_threshold: gray levels by which a corner stands out (OpenCV's default).
    """

    descriptor_dim = 256

    def __init__(self, n_features: int = 300, with_geometry: bool = False, fast_threshold: int = 20) -> None:
        super().__init__(n_features, with_geometry)
        self.fast_threshold = fast_threshold

    def _options(self) -> Settings:
        return {"fast_threshold": self.fast_threshold}

    def _describer(self) -> Describe:
        orb = cv2.ORB.create(self.n_stored, fastThreshold=self.fast_threshold)
        return lambda image: orb.detectAndCompute(image, None)


class AKAZE(_OpenCVExtractor):
    """Accelerated KAZE (Alcantarilla, Nuevo, Bartoli 2013), 486 columns: keypoints of a nonlinear scale space.

    Args:
        n_features: N, how many of the strongest features the networks read.
        with_geometry: append normalised x, y, log size and response.
        threshold: of the detector's response; lower finds more features in plain images (OpenCV's default is 0.001).
    """

    descriptor_dim = 486

    def __init__(self, n_features: int = 300, with_geometry: bool = False, threshold: float = 0.0003) -> None:
        super().__init__(n_features, with_geometry)
        self.threshold = threshold

    def _options(self) -> Settings:
        return {"threshold": self.threshold}

    def _describer(self) -> Describe:
        akaze = cv2.xfeatures2d.AKAZE.create(threshold=self.threshold)
        return lambda image: akaze.detectAndCompute(image, None)


class _FastCorners(_OpenCVExtractor):
    """Base of descriptors without a detector of their own: they are computed at FAST corners (Rosten, Drummond 2006).

    Of OpenCV's detectors only FAST finds 300 keypoints in ordinary indoor frames for both: STAR finds a third of that,
    and FREAK discards three quarters of ORB's large keypoints, because its pattern leaves the image. Corners too near
    the border to be described are dropped before the strongest are taken.

    Args:
        n_features: N, how many of the strongest features the networks read.
        with_geometry: append normalised x, y, log size and response.
        fast_threshold: gray levels by which a corner stands out (OpenCV's default).
    """

    def __init__(self, n_features: int = 300, with_geometry: bool = False, fast_threshold: int = 10) -> None:
        super().__init__(n_features, with_geometry)
        self.fast_threshold = fast_threshold

    def _options(self) -> Settings:
        return {"detector": "fast", "fast_threshold": self.fast_threshold}

    def _describer(self) -> Describe:
        fast, descriptor = cv2.FastFeatureDetector.create(self.fast_threshold), self._descriptor()
        return lambda image: descriptor.compute(image, fast.detect(image))

    @abstractmethod
    def _descriptor(self) -> cv2.Feature2D:
        """Make OpenCV's descriptor extractor."""


class FREAK(_FastCorners):
    """Fast retina keypoint (Alahi et al. 2012), 512 columns, at FAST corners, each in its orientation."""

    descriptor_dim = 512

    def _descriptor(self) -> cv2.Feature2D:
        return cv2.xfeatures2d.FREAK.create()


class BRIEF(_FastCorners):
    """Binary robust independent elementary features (Calonder et al. 2010), 256 columns, at FAST corners."""

    descriptor_dim = 256

    def _descriptor(self) -> cv2.Feature2D:
        return cv2.xfeatures2d.BriefDescriptorExtractor.create(32)
