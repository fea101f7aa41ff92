"""The test frames that a landmark map locates worst or refuses, and why; with pictures.

    python benchmarks/map_failures.py --root DIR --out DIR [--pgt DIR] [--worst 8]

Numbers that tell why: how sharp the image is (variance of its Laplacian by the median of the test frames), how far the
nearest training frame that looks the same way is, and with --pgt how far the given pose is from the registered SfM
pose, less the same of the training frames around it: what no map can know. About one CPU minute on the kitchen cut.

In the pictures, orange: where points should appear; green: their keypoints, inliers; red: those that are none.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import itertools
from pathlib import Path

import cv2
import numpy as np
from map_trials import (
    FittedMap,
    add_scene_arguments,
    find_truths,
    fit_map,
    list_reasons,
    load_scene,
    print_table,
)
from scipy.spatial.transform import Rotation
from scipy.stats import spearmanr

from lightning_pose.geometry.absolute_pose import CameraPose
from lightning_pose.mapping.map_localizer import MapAnswer
from lightning_pose.mapping.query_matching import QueryMatcher
from lightning_pose.models.parts.frame_cameras import list_cameras
from lightning_pose.scenes.images import read_gray, read_rgb

SAME_WAY_DEG = 30.0
INLIERS = (0, 1, 6, 10, 15, 20, 30, 10**4)
"""Bounds of the groups of frames by their inliers."""

NEIGHBOURS = 10
"""Training frames around a test frame whose poses are compared with the SfM's."""


class TestFrames:
    """The test frames, N of them: the map's answers and their errors, and what else is known of each, (N,) numbers."""

    def __init__(self, fitted: FittedMap, pgt: str | None) -> None:
        scene = fitted.data.scene
        self.answers = fitted.locate()
        self.errors = fitted.measure(self.answers)
        self.learnt = np.sort(np.concatenate([scene.splits["train"], scene.splits["val"]]))
        self.test = scene.splits["test"]
        self.position = np.array([frame.position_m for frame in scene.frames])
        self.rotation = Rotation.from_quat([frame.quat_wxyz for frame in scene.frames], scalar_first=True).as_matrix()
        self.names = [f"{frame.sequence}/{frame.image.stem.removesuffix('.color')}" for frame in scene.frames]
        sharp = np.array([cv2.Laplacian(read_gray(scene.frames[i].image), cv2.CV_64F).var() for i in self.test])
        self.sharpness = sharp / np.median(sharp)
        near = [self.find_nearest(i) for i in self.test]
        self.nearest = np.array([i for i, _, _ in near])
        self.away_m, self.turned_deg = (np.array([each[k] for each in near]) for k in (1, 2))
        self.jump_m = np.full(len(self.test), np.nan) if pgt is None else self.measure_jumps(fitted, pgt)

    def find_nearest(self, frame: int) -> tuple[int, float, float]:
        """The nearest training frame that looks the same way, how far it is, and by how much it is turned."""
        away = np.linalg.norm(self.position[self.learnt] - self.position[frame], axis=1)
        cosine = (np.einsum("fij,ij->f", self.rotation[self.learnt], self.rotation[frame]) - 1) / 2
        turned = np.degrees(np.arccos(np.clip(cosine, -1, 1)))
        best = int(np.argmin(away + np.where(turned > SAME_WAY_DEG, 1e6, 0)))
        return int(self.learnt[best]), float(away[best]), float(turned[best])

    def measure_jumps(self, fitted: FittedMap, pgt: str) -> np.ndarray:
        """By how much the given positions are off the SfM ones, less what training frames around are off."""
        sfm = load_scene(fitted.data.root or "", "sfm", pgt).scene
        place = {frame.image: frame.position_m for frame in sfm.frames}
        other = np.array([place.get(frame.image, np.full(3, np.nan)) for frame in fitted.data.scene.frames])
        known = np.isfinite(other[:, 0])
        ours, theirs = self.position[known], other[known]
        turn = Rotation.align_vectors(ours - ours.mean(0), theirs - theirs.mean(0))[0]
        off = np.full_like(other, np.nan)
        moved = turn.apply(theirs - theirs.mean(0)) + ours.mean(0) - ours
        off[known] = np.einsum("fji,fj->fi", self.rotation[known], moved)
        jumps = []
        for i in self.test:
            order = self.learnt[np.argsort(np.linalg.norm(self.position[self.learnt] - self.position[i], axis=1))]
            jumps.append(np.linalg.norm(off[i] - np.nanmean(off[order[:NEIGHBOURS]], axis=0)))
        return np.array(jumps)


def draw_frame(fitted: FittedMap, row: int, frames: TestFrames) -> np.ndarray:
    """A test frame with the points of the map, beside the nearest training frame."""
    number = int(frames.test[row])
    scene, network = fitted.data.scene, fitted.module.network
    image, beside = (read_rgb(scene.frames[i].image).copy() for i in (number, int(frames.nearest[row])))
    shown = frames.answers[row].shown
    if shown is not None:
        (camera,) = list_cameras(fitted.data, [number], network.view)
        seen, projected, observed = (
            camera.project(network.point_map.camera_correction.distort(each)) for each in shown[:3]
        )
        for point in seen:
            cv2.circle(image, tuple(map(int, point)), 1, (255, 160, 0), -1)
        for point, keypoint, inlier in zip(projected, observed, shown.inlier, strict=True):
            color = (0, 255, 0) if inlier else (255, 0, 0)
            cv2.circle(image, tuple(map(int, keypoint)), 4, color, 1)
            cv2.line(image, tuple(map(int, point)), tuple(map(int, keypoint)), color, 1)
    return np.hstack([image, beside])


def list_worst(fitted: FittedMap, frames: TestFrames, out: Path, count: int) -> list[list[object]]:
    answers, errors = frames.answers, frames.errors
    rows: list[list[object]] = []
    for rank, row in enumerate(np.argsort(-errors.position_m, kind="stable")[:count].tolist()):
        answer = answers[row]
        name = frames.names[frames.test[row]]
        picture = cv2.cvtColor(draw_frame(fitted, row, frames), cv2.COLOR_RGB2BGR)
        cv2.imwrite(str(out / f"{rank:02d}-{name.replace('/', '-')}.png"), picture)
        rows.append([
            name, f"{errors.position_m[row]:.3f} / {errors.orientation_deg[row]:.2f}",
            f"{answer.inliers} of {answer.visible}", answer.reason or "accepted", f"{frames.sharpness[row]:.2f}",
            f"{frames.away_m[row]:.3f} / {frames.turned_deg[row]:.1f}", f"{frames.jump_m[row]:.3f}",
        ])  # fmt: skip
    return rows


def compare_groups(fitted: FittedMap, frames: TestFrames) -> list[list[object]]:
    """Medians over the accepted frames, the refused ones, the best and the worst tenth."""
    answers, errors = frames.answers, frames.errors
    worst = np.quantile(errors.position_m, 0.9)
    groups = {
        "all": np.ones(len(answers), bool),
        "accepted": errors.accepted,
        "refused": ~errors.accepted,
        "worst tenth": errors.position_m >= worst,
    }
    features = fitted.data.dataset("test").data.features
    counts = (features[..., :-4] != 0).any(2).sum(1).numpy()
    inliers, visible = (np.array([getattr(answer, name) for answer in answers]) for name in ("inliers", "visible"))
    of_frame = (frames.sharpness, frames.away_m, frames.turned_deg, frames.jump_m)
    columns = (errors.position_m, counts, inliers, visible, *of_frame)
    return [
        [name, int(mask.sum()), *(f"{np.median(column[mask]):.3g}" for column in columns)]
        for name, mask in groups.items()
        if mask.any()
    ]


def compare_fallbacks(fitted: FittedMap, frames: TestFrames) -> list[list[object]]:
    """By inliers: errors of the map's poses, and of the most similar training frame's, whose points match best."""
    point_map = fitted.module.network.point_map
    matcher = QueryMatcher(point_map)
    similar = []
    for features in fitted.data.dataset("test").data.features.numpy():
        descriptors = features[(features != 0).any(1), :-4]
        frame = matcher.rank_frames(descriptors)[0]
        pose = CameraPose(point_map.given_rotation[frame], point_map.given_position[frame])
        similar.append(MapAnswer(pose, pose, 0, 0, ""))
    errors, of_similar = frames.errors, fitted.measure(similar)
    inliers = np.array([answer.inliers for answer in frames.answers])
    rows: list[list[object]] = []
    for low, high in itertools.pairwise(INLIERS):
        mask = (inliers >= low) & (inliers < high)
        if mask.any():
            each = (errors.select(mask), of_similar.select(mask))
            nearer = np.mean(each[0].position_m < each[1].position_m)
            worst = f"{each[0].position_m.max():.2f}"
            rows.append([f"{low} to {high - 1}", mask.sum(), each[0].medians, worst, each[1].medians, f"{nearer:.0%}"])
    return rows


def main() -> None:
    """Print tables for each ground truth, as Markdown, and write pictures to a folder."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    add_scene_arguments(parser)
    parser.add_argument("--out", type=Path, required=True, help="folder for pictures, outside the repository")
    parser.add_argument("--worst", type=int, default=8, help="how many frames to show")
    args = parser.parse_args()
    for truth in find_truths(args):
        out = args.out / truth
        out.mkdir(parents=True, exist_ok=True)
        with contextlib.redirect_stdout(io.StringIO()):
            fitted = fit_map(load_scene(args.root, truth, args.pgt))
        frames = TestFrames(fitted, args.pgt if truth == "original" else None)
        print(f"{fitted.data.scene.name}, {truth} ground truth; refused: {list_reasons(frames.answers)}")
        head = ["frames", "count", "error m", "features", "inliers", "visible", "sharpness"]
        print_table([*head, "nearest m", "deg", "truth m"], compare_groups(fitted, frames))
        head = ["inliers", "count", "map m / deg", "worst", "most similar frame m / deg", "map nearer"]
        print_table(head, compare_fallbacks(fitted, frames))
        head = ["frame", "m / deg", "inliers", "", "sharpness", "nearest training frame", "truth m"]
        print_table(head, list_worst(fitted, frames, out, args.worst))
        if args.pgt and truth == "original":
            correlation = spearmanr(frames.errors.position_m, frames.jump_m)[0]
            print(f"rank correlation of the error with the truth's: {correlation:.2f}")
        print(f"pictures: {out}")


if __name__ == "__main__":
    main()
