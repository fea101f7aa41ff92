"""Time of a query, from an image file to a pose: whole, and stage by stage, beside OpenCV's SIFT on the same frames.

    python -m benchmarks.query MODEL --images DIR [--frames 20] [--rounds 3]

MODEL is a checkpoint of a landmark map of SURF keypoints, or what else `Localizer.load` takes. One thread; CPU time,
which other programs on the machine hardly change, medians over frames and rounds. SIFT detects and describes as many
keypoints as the map's extractor, in the same rounds.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from pathlib import Path
from statistics import median
from typing import TypeVar

import cv2
import numpy as np
import torch

from benchmarks.measurement import ROOT, Goal, Measurement, Options, time_process
from lightning_pose import Localizer
from lightning_pose.features.surf import SURF
from lightning_pose.features.surf.descriptor import compute_descriptors
from lightning_pose.features.surf.detector import detect_keypoints
from lightning_pose.features.surf.hessian import compute_integral_image
from lightning_pose.geometry.absolute_pose import find_pose_ransac, refine_pose
from lightning_pose.localization.trained_system import TrainedSystem
from lightning_pose.mapping.map_localizer import CANDIDATES, RANSAC_PX, SIGMA_PX, MapLocalizer
from lightning_pose.mapping.query_matching import QueryMatcher
from lightning_pose.models.parts.map_network import keypoints_to_frames
from lightning_pose.scenes.images import read_gray

SUFFIXES = {".jpg", ".jpeg", ".png"}
LIMIT_MS = 50

Found = TypeVar("Found")


class Stages:
    """CPU milliseconds of each stage, one number a query."""

    def __init__(self) -> None:
        self.milliseconds: dict[str, list[float]] = defaultdict(list)

    def time(self, name: str, work: Callable[[], Found]) -> Found:
        """What `work` returns; its time counts for the stage of this name."""
        start = time.process_time()
        found = work()
        self.milliseconds[name].append(1e3 * (time.process_time() - start))
        return found


@torch.inference_mode()
def time_stages(stages: Stages, path: Path, system: TrainedSystem, surf: SURF, matcher: QueryMatcher) -> None:
    """Run the stages of one query one by one."""
    network = system.model.map_network
    assert network is not None, "checked"
    gray = torch.from_numpy(stages.time("read and decode, gray", lambda: read_gray(path)))[None]
    integral = stages.time("SURF: integral image", lambda: compute_integral_image(gray))
    n = surf.n_stored
    found = stages.time("SURF: keypoints", lambda: detect_keypoints(integral, n, surf.threshold))
    image = torch.zeros(n, dtype=torch.int64)
    stages.time("SURF: descriptors", lambda: compute_descriptors(integral, image, found.xy[0], found.size[0]))
    features = torch.from_numpy(surf.features(surf.extract([gray[0].numpy()])[0])[None])
    nowhere = np.zeros((1, 3, 3)), np.zeros((1, 3))
    query = stages.time(
        "map: rays of keypoints", lambda: keypoints_to_frames(features, [network.view], *nowhere).query(0)
    )
    points = network.point_map.camera_correction.remove(query.points)
    ranked = stages.time("map: votes", lambda: matcher.rank_frames(query.descriptors)[:CANDIDATES])
    rows, matched = stages.time("map: matches", lambda: matcher.match_frames(query.descriptors, ranked))
    place, sigma = matcher.map.points, SIGMA_PX / query.focal_px
    ransac = stages.time(
        "map: RANSAC", lambda: find_pose_ransac(place[matched], points[rows], RANSAC_PX / query.focal_px)
    )
    if ransac is None:
        return
    pose, mask = ransac
    near = stages.time(
        "map: first refinement", lambda: refine_pose(pose, place[matched[mask]], points[rows[mask]], 2 * sigma).pose
    )
    rows, matched, _ = stages.time("map: guided matches", lambda: matcher.match_guided(query, points, near))
    stages.time("map: last refinement", lambda: refine_pose(near, place[matched], points[rows], sigma))


def measure(options: Options) -> Iterator[Measurement]:
    """One row: queries of a map of 300 U-SURF, which is built of `--root`, from image files to poses."""
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    with tempfile.TemporaryDirectory() as folder:
        data = ["--data.root", str(Path(str(options.root)).resolve()), "--report.log_model", "false"]
        config = str(ROOT / "configs" / "landmark_map.yaml")
        fit = [sys.executable, "-m", "lightning_pose", "fit", "--config", config, *data]
        time_process(fit, Path(folder), {"LIGHTNING_POSE_CACHE": folder})
        (checkpoint,) = Path(folder).glob("mlruns/checkpoints/*/best.ckpt")
        localizer, sift, stages = Localizer.load(checkpoint), cv2.SIFT.create(300), Stages()
    paths = find_images(Path(str(options.root)), 20)
    localizer.localize(paths[0])
    for path in paths * (options.rounds or 3):
        gray = read_gray(path)
        stages.time("SIFT", lambda gray=gray: sift.detectAndCompute(gray, None))
        stages.time("query", lambda path=path: localizer.localize(path))
    ours, theirs = stages.milliseconds["query"], stages.milliseconds["SIFT"]
    ratio = median(a / b for a, b in zip(ours, theirs, strict=True))
    what, peer = "a query of a landmark map, file to pose", "OpenCV's SIFT alone, 300 features"
    yield Measurement(what, median(ours), peer, median(theirs), ratio, Goal("ours", LIMIT_MS), unit="ms CPU")


def find_images(folder: Path, count: int) -> list[Path]:
    """So many images, evenly spread over those of a folder and below it."""
    paths = sorted(p for p in folder.rglob("*") if p.suffix.lower() in SUFFIXES and "depth" not in p.name)
    if not paths:
        raise SystemExit(f"no {', '.join(sorted(SUFFIXES))} images below {folder}; give a folder that has some")
    return paths[:: max(len(paths) // count, 1)][:count]


def main() -> None:
    """Print the median times, as Markdown."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("model", help="checkpoint of a landmark map")
    parser.add_argument("--images", type=Path, required=True, help="folder of images")
    parser.add_argument("--frames", type=int, default=20, help="how many of the images to use, evenly spread")
    parser.add_argument("--rounds", type=int, default=3)
    args = parser.parse_args()
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    localizer, system = Localizer.load(args.model), TrainedSystem.from_checkpoint(args.model)
    surf, network = system.extractor, system.model.map_network
    if network is None or not isinstance(surf, SURF):
        raise SystemExit(f"{args.model} is no landmark map of SURF keypoints; give the checkpoint of one")
    paths = find_images(args.images, args.frames)
    matcher = QueryMatcher(network.point_map)
    MapLocalizer(network.point_map)  # the first call builds tables
    sift, stages, ratios = cv2.SIFT.create(surf.n_features), Stages(), []
    localizer.localize(paths[0])
    for path in paths * args.rounds:
        gray = read_gray(path)
        stages.time("SIFT", lambda gray=gray: sift.detectAndCompute(gray, None))
        stages.time("query", lambda path=path: localizer.localize(path))
        ratios.append(stages.milliseconds["query"][-1] / stages.milliseconds["SIFT"][-1])
        time_stages(stages, path, system, surf, matcher)
    print(f"{len(paths)} frames, {args.rounds} rounds, N = {surf.n_features}, {len(matcher.map)} map points")
    print("| stage | ms, CPU |\n|---|---|")
    for name, values in stages.milliseconds.items():
        print(f"| {name} | {median(values):.2f} |")
    print(f"query by SIFT: {median(ratios):.3f}")


if __name__ == "__main__":
    main()
