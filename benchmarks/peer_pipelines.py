"""Classical pipelines, peers of the landmark map: features, a map of posed frames, retrieval, and a query's pose."""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
from scipy.spatial.transform import Rotation
from sklearn.cluster import MiniBatchKMeans

from lightning_pose.features.matching import match_descriptors
from lightning_pose.geometry.camera import Camera
from lightning_pose.geometry.epipolar import essential_matrices, sampson_distances_px
from lightning_pose.mapping.frames import MapFrames
from lightning_pose.mapping.pairs import choose_pairs
from lightning_pose.mapping.scene_depth import estimate_depth
from lightning_pose.scenes.images import read_gray
from lightning_pose.scenes.scene import Scene

__all__ = ["BINARY_RATIO", "Retrieval", "ask_peer", "make_extractor", "stack_poses", "triangulate"]

EPIPOLAR_PX = 4.0
WORDS = 64
BINARY_RATIO = 0.894  # of Euclidean distances: 0.8 of Hamming's

Features = tuple[np.ndarray, np.ndarray]
"""Keypoints (N, 2) in pixels, the first pixel's centre (0, 0); descriptors (N, D)."""


def make_extractor(name: str) -> Callable[[np.ndarray], Features]:
    """The features of a peer: a function of a grayscale image."""
    if name == "pycolmap SIFT":
        import pycolmap  # pyright: ignore[reportMissingImports]

        options = pycolmap.FeatureExtractionOptions()
        options.num_threads, options.use_gpu = 1, False
        sift = pycolmap.Sift(options)

        def extract(image: np.ndarray) -> Features:
            keypoints, descriptors = sift.extract(image.astype(np.float32) / np.float32(255))
            return keypoints[:, :2] - 0.5, descriptors / np.linalg.norm(descriptors, axis=1, keepdims=True)

        return extract
    orb = "ORB" in name
    detector = cv2.ORB.create(1000) if orb else cv2.SIFT.create(2000)

    def extract_opencv(image: np.ndarray) -> Features:
        keypoints, found = detector.detectAndCompute(image, None)
        descriptors = np.asarray(found)
        places = np.array([keypoint.pt for keypoint in keypoints], np.float64).reshape(-1, 2)
        if orb:  # bits as signs: the product of two descriptors is linear in Hamming's distance
            return places, (np.unpackbits(np.asarray(found, np.uint8), axis=1).astype(np.float32) * 2 - 1) / 16
        root = np.sqrt(descriptors / np.maximum(descriptors.sum(axis=1, keepdims=True), 1e-9))
        return places, root

    return extract_opencv


def triangulate(scene: Scene, frames: np.ndarray, camera: Camera, features: list[Features], ratio: float) -> dict:
    """Match pairs of posed frames, keep what lies on epipolar lines, and triangulate: the points of each frame."""
    import pycolmap  # pyright: ignore[reportMissingImports]

    rotation, position = stack_poses(scene, frames)
    n = len(frames)
    nothing = np.zeros((n, 1))
    posed = MapFrames(
        np.zeros((n, 1, 2)), nothing, nothing[:, None], np.zeros(n), np.full(n, camera.focal_px),
        np.tile(camera.half_view, (n, 1)), rotation, position,
    )  # fmt: skip
    pairs = choose_pairs(posed, estimate_depth(rotation, position)).pairs
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "database.db"
        model = pycolmap.Reconstruction()
        colmap = pycolmap.Camera(
            model="PINHOLE", width=camera.width, height=camera.height, camera_id=1,
            params=[camera.fx, camera.fy, camera.cx + 0.5, camera.cy + 0.5],
        )  # fmt: skip
        model.add_camera_with_trivial_rig(colmap)
        with pycolmap.Database.open(path) as database:
            database.write_camera(colmap, use_camera_id=True)
            database.write_rig(model.rig(1), use_rig_id=True)
            for i, (places, _) in enumerate(features):
                image = pycolmap.Image(name=f"{i}", keypoints=places + 0.5, camera_id=1, image_id=i + 1)
                to_camera = rotation[i].T
                pose = pycolmap.Rigid3d(pycolmap.Rotation3d(to_camera), -to_camera @ position[i])
                model.add_image_with_trivial_frame(image, pose)
                database.write_frame(model.frame(i + 1), use_frame_id=True)
                database.write_image(model.image(i + 1), use_image_id=True)
                database.write_keypoints(i + 1, (places + 0.5).astype(np.float32))
            essential = essential_matrices(
                rotation[pairs[:, 0]], position[pairs[:, 0]], rotation[pairs[:, 1]], position[pairs[:, 1]]
            )
            centre = np.array([camera.cx, camera.cy])
            for (a, b), matrix in zip(pairs.tolist(), essential, strict=True):
                rows = match_descriptors(features[a][1], features[b][1], ratio)
                places = [features[k][0][row] - centre for k, row in zip((a, b), rows, strict=True)]
                each = np.tile(matrix, (len(rows[0]), 1, 1))
                near = sampson_distances_px(each, places[0], places[1], camera.focal_px)
                matches = np.stack(rows, axis=1)[near < EPIPOLAR_PX].astype(np.uint32)
                if len(matches) >= 8:
                    pair = pycolmap.TwoViewGeometry()
                    pair.config, pair.inlier_matches = pycolmap.TwoViewGeometryConfiguration.CALIBRATED, matches
                    database.write_two_view_geometry(a + 1, b + 1, pair)
        pycolmap.logging.minloglevel = 2  # errors alone
        options = pycolmap.IncrementalPipelineOptions()
        options.num_threads = 1
        model = pycolmap.triangulate_points(model, path, folder, folder, options=options)
    number = {point: k for k, point in enumerate(model.points3D)}
    seen = []
    for i in range(n):
        points = model.image(i + 1).points2D
        kept = [k for k, point in enumerate(points) if point.has_point3D()]
        seen.append((np.array(kept, np.int32), np.array([number[points[k].point3D_id] for k in kept], np.int32)))
    return {"points": np.array([point.xyz for point in model.points3D.values()]).reshape(-1, 3), "seen": seen}


class Retrieval:
    """VLAD of local descriptors (Jegou et al., CVPR 2010): which frames look like a query."""

    def __init__(self, features: list[Features]) -> None:
        sample = np.concatenate([descriptors[:: max(len(descriptors) // 50, 1)] for _, descriptors in features])
        words = MiniBatchKMeans(WORDS, random_state=0).fit(sample)
        self.means = np.asarray(words.cluster_centers_, np.float32)
        self.frames = np.array([self.describe(descriptors) for _, descriptors in features])

    def describe(self, descriptors: np.ndarray) -> np.ndarray:
        word = (descriptors @ self.means.T - (self.means**2).sum(axis=1) / 2).argmax(axis=1)
        vlad = np.zeros_like(self.means)
        np.add.at(vlad, word, descriptors - self.means[word])
        vlad /= np.maximum(np.linalg.norm(vlad, axis=1, keepdims=True), 1e-9)
        return (vlad / np.linalg.norm(vlad)).ravel()

    def rank(self, descriptors: np.ndarray) -> np.ndarray:
        return np.argsort(-(self.frames @ self.describe(descriptors)), kind="stable")


def ask_peer(
    image: Path, extract: Callable, retrieval: Retrieval, model: dict, frames: list[Features], camera: Camera, top: int,
    ratio: float,
) -> tuple[np.ndarray, np.ndarray] | None:  # fmt: skip
    """Camera-to-world rotation and position of an image file; None where there is none."""
    import pycolmap  # pyright: ignore[reportMissingImports]

    places, descriptors = extract(read_gray(image))
    rows, points = [], []
    for frame in retrieval.rank(descriptors)[:top]:
        kept, point = model["seen"][frame]
        if len(kept) < 2:
            continue
        of_query, of_frame = match_descriptors(descriptors, frames[frame][1][kept], ratio)
        rows.append(of_query)
        points.append(point[of_frame])
    if not rows:
        return None
    unique = np.unique(np.stack([np.concatenate(rows), np.concatenate(points)], axis=1), axis=0)
    answer = pycolmap.estimate_and_refine_absolute_pose(
        places[unique[:, 0]] + 0.5,
        model["points"][unique[:, 1]],
        pycolmap.Camera(
            model="PINHOLE", width=camera.width, height=camera.height,
            params=[camera.fx, camera.fy, camera.cx + 0.5, camera.cy + 0.5],
        ),
    )  # fmt: skip
    if answer is None:
        return None
    to_camera = answer["cam_from_world"].matrix()
    return to_camera[:, :3].T, -to_camera[:, :3].T @ to_camera[:, 3]


def stack_poses(scene: Scene, frames: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(F, 3, 3) camera-to-world rotations, (F, 3) positions."""
    quats = np.array([scene.frames[i].quat_wxyz for i in frames])
    position = np.array([scene.frames[i].position_m for i in frames])
    return Rotation.from_quat(quats, scalar_first=True).as_matrix(), position
