"""COLMAP's database of a reconstruction: cameras, images, keypoints and matches, filled bit by bit."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pycolmap

__all__ = ["Features", "ImageDatabase", "open_database"]

Features = tuple[np.ndarray, np.ndarray]
"""Of an image: (N, 4) float32 keypoints x, y, scale, angle in COLMAP's pixels, and (N, 128) uint8 descriptors."""

pycolmap.logging.minloglevel = int(pycolmap.logging.FATAL.value)  # it writes to the terminal what errors here say


class ImageDatabase:
    """The images of a reconstruction in the order of their numbers, from 1.

    Args:
        database: open.
    """

    def __init__(self, database: pycolmap.Database) -> None:
        self._database = database

    def add_images(self, names: Sequence[str], cameras: Sequence[pycolmap.Camera], camera_of: Sequence[int]) -> None:
        """Write cameras and images, unless the database has them.

        Args:
            names: of N images.
            cameras: the different ones.
            camera_of: N rows of `cameras`.
        """
        if self._database.num_images():
            return
        with pycolmap.DatabaseTransaction(self._database):
            model = pycolmap.Reconstruction()
            for number, camera in enumerate(cameras, start=1):
                camera.camera_id = number
                model.add_camera_with_trivial_rig(camera)
                self._database.write_camera(camera, use_camera_id=True)
                self._database.write_rig(model.rig(number), use_rig_id=True)
            for number, (name, row) in enumerate(zip(names, camera_of, strict=True), start=1):
                image = pycolmap.Image(name=name, camera_id=row + 1, image_id=number)
                model.add_image_with_trivial_frame(image)
                self._database.write_frame(model.frame(number), use_frame_id=True)
                self._database.write_image(model.image(number), use_image_id=True)

    def has_features(self, row: int) -> bool:
        return self._database.exists_keypoints(row + 1)

    def count_keypoints(self, row: int) -> int:
        return self._database.num_keypoints_for_image(row + 1)

    def write_features(self, row: int, features: Features) -> None:
        keypoints, descriptors = features
        with pycolmap.DatabaseTransaction(self._database):
            stored = pycolmap.FeatureDescriptors(pycolmap.FeatureExtractorType.SIFT, descriptors)
            self._database.write_descriptors(row + 1, stored)
            self._database.write_keypoints(row + 1, keypoints)

    def read_features(self, row: int) -> Features:
        return self._database.read_keypoints(row + 1), np.asarray(self._database.read_descriptors(row + 1).data)

    def read_camera(self, row: int) -> pycolmap.Camera:
        return self._database.read_camera(self._database.read_image(row + 1).camera_id)

    def has_pair(self, a: int, b: int) -> bool:
        return self._database.exists_two_view_geometry(a + 1, b + 1)

    def write_pair(self, a: int, b: int, geometry: pycolmap.TwoViewGeometry) -> None:
        self._database.write_two_view_geometry(a + 1, b + 1, geometry)

    def list_pairs(self) -> Iterator[tuple[int, int, np.ndarray, int]]:
        """Rows of both images of each verified pair, its (K, 2) matches, and its `TwoViewGeometryConfiguration`."""
        for number, geometry in zip(*self._database.read_two_view_geometries(), strict=True):
            if len(geometry.inlier_matches):
                a, b = pycolmap.pair_id_to_image_pair(number)
                yield a - 1, b - 1, geometry.inlier_matches, int(geometry.config)


@contextmanager
def open_database(path: Path) -> Iterator[ImageDatabase]:
    """Open a database, or create one, and close it at the end."""
    database = pycolmap.Database.open(path)
    try:
        yield ImageDatabase(database)
    finally:
        database.close()
