"""The landmark map beside classical pipelines: the same frames, the same poses, one thread, CPU time.

    python benchmarks/peers.py --root DIR --work DIR [--pgt DIR] [--only NAME ...]

Peers follow hloc's steps (Sarlin et al., CVPR 2019): local features, pairs of frames from their poses, matching,
triangulation from the given poses (pycolmap), VLAD retrieval, matching to the best frames, PnP with LO-RANSAC
(pycolmap). Their features are pycolmap's SIFT, OpenCV's SIFT, and OpenCV's ORB. The landmark map is built of 300, 500
or 1000 U-SURF; whether it adjusts the poses is chosen on validation frames, as `bundle_adjust: auto` chooses.

Each step is kept in `--work`, so that a run that was stopped goes on where it was. Needs the extra `peers`.
"""

from __future__ import annotations

import argparse
import pickle
import platform
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

import cv2
import numpy as np
import torch
from scipy.spatial.transform import Rotation
from sklearn.cluster import MiniBatchKMeans

from lightning_pose.data.scene_folders import SceneFolders
from lightning_pose.features.matching import match_descriptors
from lightning_pose.features.surf import SURF
from lightning_pose.geometry.camera import Camera
from lightning_pose.geometry.epipolar import essential_matrices, sampson_distances_px
from lightning_pose.mapping.build_map import adjust_mapped, map_frames, summarize_tracks
from lightning_pose.mapping.calibration import measure_frames
from lightning_pose.mapping.frames import MapFrames
from lightning_pose.mapping.map_localizer import MapLocalizer
from lightning_pose.mapping.pairs import choose_pairs
from lightning_pose.mapping.scene_depth import estimate_depth
from lightning_pose.models.parts.map_network import keypoints_to_frames
from lightning_pose.scenes.images import read_gray
from lightning_pose.scenes.scene import Scene

PEERS = {"pycolmap SIFT": 20, "OpenCV SIFT 2000": 10, "OpenCV ORB 1000": 10}
"""Frames that a query is matched to."""

MAPS = {"LandmarkMap 300": 300, "LandmarkMap 500": 500, "LandmarkMap 1000": 1000}

EPIPOLAR_PX = 4.0
WORDS = 64
BINARY_RATIO = 0.894  # of Euclidean distances: 0.8 of Hamming's

Found = TypeVar("Found")
Features = tuple[
    np.ndarray, np.ndarray
]  # keypoints (N, 2) in pixels, the first pixel's centre (0, 0); descriptors (N, D)


class Work:
    """Results of steps, each with its CPU seconds, in files of one folder."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        folder.mkdir(parents=True, exist_ok=True)

    def keep(self, name: str, step: Callable[[], Found]) -> tuple[Found, float]:
        """What `step` returns, and how many CPU seconds it took when it was done."""
        path = self.folder / f"{name.replace(' ', '_')}.pkl"
        if not path.exists():
            print(f"... {name}", flush=True)
            start = time.process_time()
            found = step()
            path.write_bytes(pickle.dumps((found, time.process_time() - start)))
        return pickle.loads(path.read_bytes())  # noqa: S301  # written here, a few lines above


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


def run_peer(name: str, work: Work, scene: Scene, truth: str, camera: Camera) -> list[str]:
    """Build and ask a peer's map; a row of the table."""
    extract = make_extractor(name)
    ratio = BINARY_RATIO if "ORB" in name else 0.8
    train, test = (np.sort(np.concatenate([scene.splits[s] for s in part])) for part in (("train", "val"), ("test",)))
    paths = [scene.frames[i].image for i in train]
    features, extract_s = work.keep(f"{name} features", lambda: [extract(read_gray(path)) for path in paths])
    model, map_s = work.keep(f"{name} map {truth}", lambda: triangulate(scene, train, camera, features, ratio))
    retrieval, retrieval_s = work.keep(f"{name} retrieval", lambda: Retrieval(features))

    def ask() -> list:
        images = [scene.frames[i].image for i in test]
        return [ask_peer(each, extract, retrieval, model, features, camera, PEERS[name], ratio) for each in images]

    answers, ask_s = work.keep(f"{name} answers {truth}", ask)
    rotation, position = stack_poses(scene, test)
    found = [answer or (np.eye(3), np.full(3, np.inf)) for answer in answers]
    position_m = np.linalg.norm(np.array([c for _, c in found]) - position, axis=1)
    turned = Rotation.from_matrix(np.array([r for r, _ in found]).transpose(0, 2, 1) @ rotation).magnitude()
    n_bytes = model["points"].astype(np.float32).nbytes + retrieval.frames.nbytes
    for (_, descriptors), (kept, point) in zip(features, model["seen"], strict=True):
        each = 32 if "ORB" in name else descriptors.shape[1]  # bytes: bits, or one of each number
        n_bytes += len(kept) * each + point.nbytes
    per_query = ask_s / len(test) * 1e3
    return make_row(name, truth, position_m, np.degrees(turned), extract_s, map_s + retrieval_s, n_bytes, per_query)


def run_map(name: str, work: Work, scene: Scene, truth: str, camera: Camera) -> list[str]:
    """Build and ask a landmark map; a row of the table."""
    surf = SURF(MAPS[name], with_geometry=True)
    origin = np.mean([scene.frames[i].position_m for i in scene.splits["train"]], axis=0)

    def extract(frames: np.ndarray) -> torch.Tensor:
        (records,) = [[record for i in frames for record in surf.extract([read_gray(scene.frames[i].image)])]]
        return torch.from_numpy(np.stack([surf.features(record) for record in records]))

    def to_frames(features: torch.Tensor, frames: np.ndarray) -> MapFrames:
        rotation, position = stack_poses(scene, frames)
        return keypoints_to_frames(features, [camera] * len(frames), rotation, position - origin)

    train, val, test = (scene.splits[split] for split in ("train", "val", "test"))
    every = np.sort(np.concatenate([train, val]))
    features, extract_s = work.keep(f"{name} features", lambda: extract(every))

    def choose() -> bool:
        plain = map_frames(to_frames(features[torch.from_numpy(np.isin(every, train))], train), adjust=False)
        asked = to_frames(features[torch.from_numpy(np.isin(every, val))], val)
        before, after = (
            np.median(measure_frames(MapLocalizer(summarize_tracks(each)), asked).position)
            for each in (plain, adjust_mapped(plain, rounds=2))
        )
        return bool(after < before)

    adjust, choose_s = work.keep(f"{name} adjust {truth}", choose)
    frames = to_frames(features, every)
    point_map, map_s = work.keep(f"{name} map {truth}", lambda: summarize_tracks(map_frames(frames, adjust)))
    localizer = MapLocalizer(point_map)
    asked, extract_test_s = work.keep(f"{name} test features", lambda: extract(test))
    queries = to_frames(asked, test)
    found, ask_s = work.keep(f"{name} answers {truth}", lambda: measure_frames(localizer, queries))
    per_query = (extract_test_s + ask_s) / len(test) * 1e3
    label = f"{name}{', adjusted' if adjust else ''}"
    seconds = f"{map_s:.0f} (+ {choose_s:.0f} to choose)"
    return make_row(label, truth, *found[:2], extract_s, seconds, point_map.n_bytes, per_query)


def make_row(
    name: str, truth: str, position_m: np.ndarray, orientation_deg: np.ndarray, extract_s: float, map_s: float | str,
    n_bytes: int, query_ms: float,
) -> list[str]:  # fmt: skip
    shares = [np.mean((position_m <= cm / 100) & (orientation_deg <= deg)) for cm, deg in ((1, 1), (2, 2), (5, 5))]
    return [
        name, truth, f"{np.median(position_m):.4f} / {np.median(orientation_deg):.3f}",
        " / ".join(f"{share:.0%}" for share in shares), f"{extract_s:.0f}",
        map_s if isinstance(map_s, str) else f"{map_s:.0f}", f"{n_bytes / 1e6:.1f}", f"{query_ms:.0f}",
    ]  # fmt: skip


def stack_poses(scene: Scene, frames: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(F, 3, 3) camera-to-world rotations, (F, 3) positions."""
    quats = np.array([scene.frames[i].quat_wxyz for i in frames])
    position = np.array([scene.frames[i].position_m for i in frames])
    return Rotation.from_quat(quats, scalar_first=True).as_matrix(), position


def find_processor() -> str:
    """The processor's name, where the system tells it."""
    info = Path("/proc/cpuinfo")
    lines = info.read_text().splitlines() if info.exists() else []
    return next((line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")), platform.machine())


def main() -> None:
    """Print the table, as Markdown."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--root", required=True, help="the scene's folder")
    parser.add_argument("--pgt", help="folder of the pseudo ground truth: every row also under SfM poses")
    parser.add_argument("--work", type=Path, required=True, help="folder for what each step finds")
    parser.add_argument("--only", nargs="+", choices=[*PEERS, *MAPS], default=[*PEERS, *MAPS])
    args = parser.parse_args()
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    rows = []
    for name in args.only:
        for truth in ("original", "sfm") if args.pgt else ("original",):
            pgt = args.pgt if truth == "sfm" else None
            scene = SceneFolders(args.root, ground_truth=truth, pgt=pgt).load(None, one_world=True)
            first = scene.frames[int(scene.splits["train"][0])]
            if first.intrinsics is None:
                raise SystemExit(f"{args.root} has no camera, and the peers need one")
            height, width = read_gray(first.image).shape
            known = first.intrinsics.for_size(width, height)
            camera = Camera(width, height, known.fx, known.fy, known.cx, known.cy)
            rows.append((run_peer if name in PEERS else run_map)(name, Work(args.work), scene, truth, camera))
    print(f"{scene.name}: {find_processor()}, one thread, CPU time")
    head = ["pipeline", "ground truth", "m / deg", "1 / 2 / 5 cm", "extract s", "map s", "map MB", "query ms"]
    for row in (head, ["---"] * len(head), *rows):
        print(f"| {' | '.join(row)} |")


if __name__ == "__main__":
    main()
