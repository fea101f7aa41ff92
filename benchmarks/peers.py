"""The landmark map beside classical pipelines: the same frames, the same poses, one thread, CPU time.

    python -m benchmarks.peers --root DIR --work DIR [--pgt DIR] [--only NAME ...]

Peers follow hloc's steps (Sarlin et al., CVPR 2019): local features, pairs of frames from their poses, matching,
triangulation from the given poses (pycolmap), VLAD retrieval, matching to the best frames, PnP with LO-RANSAC
(pycolmap). Their features are pycolmap's SIFT, OpenCV's SIFT, and OpenCV's ORB. The landmark map is built of 300, 500
or 1000 U-SURF; whether it adjusts the poses is chosen on validation frames, as `bundle_adjust: auto` chooses.

Each step is kept in `--work`, so that a run that was stopped goes on where it was. Needs the extra `peers`.
"""

from __future__ import annotations

import argparse
import pickle
import time
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

import cv2
import numpy as np
import torch
from scipy.spatial.transform import Rotation

from benchmarks.measurement import describe_machine
from benchmarks.peer_pipelines import BINARY_RATIO, Retrieval, ask_peer, make_extractor, stack_poses, triangulate
from lightning_pose.data.scene_folders import SceneFolders
from lightning_pose.features.surf import SURF
from lightning_pose.geometry.camera import Camera
from lightning_pose.mapping.build_map import adjust_mapped, map_frames, summarize_tracks
from lightning_pose.mapping.calibration import measure_frames
from lightning_pose.mapping.frames import MapFrames
from lightning_pose.mapping.map_localizer import MapLocalizer
from lightning_pose.models.parts.map_network import keypoints_to_frames
from lightning_pose.scenes.images import read_gray
from lightning_pose.scenes.scene import Scene

PEERS = {"pycolmap SIFT": 20, "OpenCV SIFT 2000": 10, "OpenCV ORB 1000": 10}
"""Frames that a query is matched to."""

MAPS = {"LandmarkMap 300": 300, "LandmarkMap 500": 500, "LandmarkMap 1000": 1000}

Found = TypeVar("Found")


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
    print(f"{scene.name}, one thread, CPU time: {describe_machine()}\n")
    head = ["pipeline", "ground truth", "m / deg", "1 / 2 / 5 cm", "extract s", "map s", "map MB", "query ms"]
    for row in (head, ["---"] * len(head), *rows):
        print(f"| {' | '.join(row)} |")


if __name__ == "__main__":
    main()
