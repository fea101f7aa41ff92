"""Time of building a landmark map as `fit` does it, stage by stage, from image files on.

    python -m benchmarks.map_build --root DIR [--pgt DIR] [--threads 1 2] [--n_features 300]

Stages: decoding the images of training and validation and extracting SURF; the map of the training frames; its bundle
adjustment; the same for a rolling shutter; which of the three locates validation frames best; the validation frames
added to that, with new matches and adjustment once more, or where adjusting helped nothing a map of all frames as they
are; the radii. Evaluation, imports and checkpoints are not in it. The hash of the map is the same for any number of
threads.
"""

from __future__ import annotations

import argparse
import hashlib
import math
import time
from collections.abc import Callable, Iterator
from contextlib import redirect_stdout
from io import StringIO
from typing import TypeVar

import cv2
import numpy as np
import torch
from scipy.spatial.transform import Rotation

from benchmarks.measurement import Goal, Measurement, Options, time_work
from lightning_pose.data.scene_folders import SceneFolders
from lightning_pose.features.surf import SURF
from lightning_pose.geometry.absolute_pose import CameraPose
from lightning_pose.geometry.camera import Camera
from lightning_pose.mapping.build_map import add_frames, adjust_mapped, map_frames, roll_mapped, summarize_tracks
from lightning_pose.mapping.calibration import calibrate_map, choose_map, measure_answers, measure_frames
from lightning_pose.mapping.frames import MapFrames
from lightning_pose.mapping.map_localizer import MapLocalizer
from lightning_pose.models.parts.map_network import keypoints_to_frames
from lightning_pose.scenes.images import read_gray
from lightning_pose.scenes.scene import Scene

LIMIT_S = 60

Found = TypeVar("Found")


def time_stage(name: str, work: Callable[[], Found], spent: list[float]) -> Found:
    """What `work` returns; a line of the table says how long it took."""
    wall, cpu = time.perf_counter(), time.process_time()
    found = work()
    wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
    spent.append(wall)
    print(f"| {name} | {wall:.2f} | {cpu:.2f} |", flush=True)
    return found


def read_frames(scene: Scene, frames: np.ndarray, n_features: int) -> MapFrames:
    """Keypoints and poses of frames, from their image files."""
    surf = SURF(n_features, with_geometry=True)
    images = [read_gray(scene.frames[i].image) for i in frames]
    features = torch.from_numpy(np.stack([surf.features(record) for record in surf.extract(images)]))
    known = scene.frames[int(frames[0])].intrinsics
    if known is None:
        raise SystemExit(f"{scene.root} has no camera; give a scene whose format has one")
    height, width = images[0].shape
    known = known.for_size(width, height)
    camera = Camera(width, height, known.fx, known.fy, known.cx, known.cy)
    quats = np.array([scene.frames[i].quat_wxyz for i in frames])
    position = np.array([scene.frames[i].position_m for i in frames])
    rotation = Rotation.from_quat(quats, scalar_first=True).as_matrix()
    return keypoints_to_frames(features, [camera] * len(frames), rotation, position)


def build(every: MapFrames, is_val: np.ndarray) -> tuple[MapLocalizer, str]:
    """Build the map of training and validation frames; also its hash."""
    train, val, spent = every.select(np.flatnonzero(~is_val)), every.select(np.flatnonzero(is_val)), []
    plain = time_stage("map of the training frames", lambda: map_frames(train, adjust=False), spent)
    adjusted = time_stage("bundle adjustment", lambda: adjust_mapped(plain, rounds=1), spent)
    rolled = time_stage("rolling shutter", lambda: roll_mapped(adjusted), spent)
    maps = [adjusted, rolled, plain]
    best, found = time_stage(
        "the best of the three, by validation frames located",
        lambda: choose_map([summarize_tracks(each) for each in maps], val),
        spent,
    )
    if maps[best] is plain:
        mapped = time_stage("map of all frames", lambda: map_frames(every, adjust=False), spent)
    else:
        back = MapLocalizer(summarize_tracks(maps[best]))
        poses = [
            answer.pose_in_map if answer.accepted else back.given_poses.carry_forward(CameraPose(rotation, position))
            for answer, rotation, position in zip(found, val.rotation, val.position, strict=True)
        ]
        rows = np.flatnonzero(~is_val)
        mapped = time_stage("validation frames added", lambda: add_frames(maps[best], every, rows, poses), spent)
    point_map = summarize_tracks(mapped)
    time_stage("radii", lambda: calibrate_map(mapped, measure_answers(found, val)), spent)
    print(f"| all without features | {sum(spent):.2f} | |")
    digest = hashlib.sha256(b"".join(array.tobytes() for _, array in sorted(vars(point_map).items())))
    return MapLocalizer(point_map), digest.hexdigest()[:12]


def read_scene(root: str, pgt: str | None) -> Scene:
    """The scene under its own poses, or under those of the pseudo ground truth."""
    return SceneFolders(root, ground_truth="sfm" if pgt else "original", pgt=pgt).load(None, one_world=True)


def measure(options: Options) -> Iterator[Measurement]:
    """One row: everything from image files to a map with radii, one thread."""
    cv2.setNumThreads(1)
    torch.set_num_threads(1)
    scene = read_scene(str(options.root), options.pgt)
    numbers = np.sort(np.concatenate([scene.splits["train"], scene.splits["val"]]))
    is_val = np.isin(numbers, scene.splits["val"])
    with redirect_stdout(StringIO()):  # the table of stages
        seconds = time_work(lambda: build(read_frames(scene, numbers, 300), is_val))
    what = f"a landmark map of {len(numbers)} frames, from image files on"
    yield Measurement(what, seconds.wall, "", math.nan, math.nan, Goal("ours", LIMIT_S), seconds.cpu)


def main() -> None:
    """Print a table for each number of threads, as Markdown."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--root", required=True, help="the scene's folder")
    parser.add_argument("--pgt", help="folder of the pseudo ground truth: SfM poses instead of the scene's own")
    parser.add_argument("--threads", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--n_features", type=int, default=300)
    args = parser.parse_args()
    cv2.setNumThreads(1)
    scene = read_scene(args.root, args.pgt)
    numbers = np.sort(np.concatenate([scene.splits["train"], scene.splits["val"]]))
    is_val = np.isin(numbers, scene.splits["val"])
    test = read_frames(scene, scene.splits["test"], args.n_features)
    for threads in args.threads:
        torch.set_num_threads(threads)
        print(f"\n{threads} threads\n\n| stage | s | s, CPU |\n|---|---|---|")
        every = time_stage("images and features", lambda: read_frames(scene, numbers, args.n_features), [])
        localizer, digest = build(every, is_val)
        found = measure_frames(localizer, test)
        errors = f"{np.median(found.position):.4f} / {np.median(found.orientation_deg):.3f}"
        print(f"\nmap {digest}: test frames {errors}, {found.accepted.mean():.0%} accepted", flush=True)


if __name__ == "__main__":
    main()
