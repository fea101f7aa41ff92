"""Keypoints for reconstruction: OpenCV's SIFT, with descriptors as COLMAP stores them."""

from __future__ import annotations

import cv2
import numpy as np

from lightning_pose.reconstruction.database import Features

__all__ = ["MAX_SIDE", "extract_features", "scale_descriptors"]

N_FEATURES = 1500

CONTRAST = 0.01
"""OpenCV's threshold, a quarter of its default: walls and blurred frames have few keypoints otherwise."""

MAX_SIDE = 1600
"""Larger images are shrunk to this many pixels across or down; keypoints are given in the pixels of the image."""


def extract_features(image: np.ndarray) -> Features:
    """Keypoints and RootSIFT descriptors (Arandjelovic & Zisserman, CVPR 2012) of a gray image (H, W) uint8.

    OpenCV's SIFT takes a quarter of the time of pycolmap's.
    """
    shrunk = MAX_SIDE / max(image.shape)
    if shrunk < 1:
        image = cv2.resize(image, None, fx=shrunk, fy=shrunk, interpolation=cv2.INTER_AREA)
    found, descriptors = cv2.SIFT.create(N_FEATURES, contrastThreshold=CONTRAST).detectAndCompute(image, None)
    if not found:
        return np.zeros((0, 4), np.float32), np.zeros((0, 128), np.uint8)
    root = np.sqrt(descriptors / np.maximum(descriptors.sum(axis=1, keepdims=True), 1e-9))
    points = np.array([[*keypoint.pt, keypoint.size / 2, np.radians(keypoint.angle)] for keypoint in found], np.float32)
    points[:, :2] += 0.5  # COLMAP counts from the corner of the first pixel
    points[:, :3] /= min(shrunk, 1)
    return points, np.minimum(np.rint(512 * root), 255).astype(np.uint8)


def scale_descriptors(descriptors: np.ndarray) -> np.ndarray:
    """(N, 128) float32 of unit length."""
    values = descriptors.astype(np.float32)
    return values / np.maximum(np.linalg.norm(values, axis=1, keepdims=True), 1e-9)
