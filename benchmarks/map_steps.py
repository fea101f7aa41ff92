"""What each step of the landmark map is good for: the same scene with each step left out once.

    python benchmarks/map_steps.py --root DIR [--pgt DIR] [--only STEP ...]

Whether poses are adjusted is chosen once, with all steps, and holds for all rows. A row replaces functions or
constants of `lightning_pose.mapping`; steps whose names are gone are named and passed over. Steps of the query are left
out with the map of the first row. A row takes about 40 CPU seconds on the kitchen cut, one of a query step 2.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, ExitStack
from functools import partial
from unittest.mock import patch

import numpy as np
from map_trials import FittedMap, add_scene_arguments, find_truths, fit_map, load_scene, print_table
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from lightning_pose.geometry.absolute_pose import CameraPose
from lightning_pose.mapping import (
    build_map,
    bundle_adjustment,
    guided_matching,
    map_localizer,
    pairs,
    query_matching,
    scene_depth,
    track_points,
)
from lightning_pose.mapping.frames import MapFrames, MapQuery
from lightning_pose.mapping.given_poses import GivenPoses
from lightning_pose.mapping.guided_matching import KeypointMatches
from lightning_pose.mapping.query_matching import QueryMatcher

Patches = list[AbstractContextManager]


def replace_all(owner: object, **values: object) -> Patches:
    """Other values for attributes of a module or class, which must be there."""
    return [patch.object(owner, name, value) for name, value in values.items()]


def choose_nearest(frames: MapFrames, depth: float) -> pairs.FramePairs:
    """Each frame with the nearest ones that look the same way, not too near to triangulate."""
    baseline = np.linalg.norm(frames.position[:, None] - frames.position[None], axis=2)
    axis = frames.rotation[:, :, 2]
    found = set()
    for i, row in enumerate(np.where(axis @ axis.T > np.cos(np.radians(20)), baseline, np.inf)):
        near = np.flatnonzero((row >= pairs.MIN_BASELINE * depth) & np.isfinite(row))
        found |= {(min(i, j), max(i, j)) for j in near[np.argsort(row[near], kind="stable")][: pairs.PARTNERS].tolist()}
    return pairs.FramePairs(np.array(sorted(found), np.int64), few=False)


def keep_every_match(frames: MapFrames, matches: KeypointMatches) -> np.ndarray:
    return np.ones(len(matches.distance), bool)


def join_connected(matches: KeypointMatches, n_keypoints: int, min_length: int) -> tuple[np.ndarray, ...]:
    """Tracks of everything that is linked, even two keypoints of one frame."""
    ids = matches.frame * n_keypoints + matches.keypoint
    nodes, index = np.unique(ids, return_inverse=True)
    a, b = index.reshape(-1, 2).T
    _, track = connected_components(coo_matrix((np.ones(len(a)), (a, b)), shape=(len(nodes),) * 2), directed=False)
    kept = np.bincount(track)[track] >= min_length
    _, track = np.unique(track[kept], return_inverse=True)
    order = np.lexsort((nodes[kept], track))
    nodes = nodes[kept][order]
    return track[order], nodes // n_keypoints, nodes % n_keypoints


def take_first_descriptor(sum_by_track: Callable) -> Callable:
    """Sums, but of descriptors the first of each track."""

    def sum_or_first(track: np.ndarray, values: np.ndarray, n_tracks: int) -> np.ndarray:
        if values.shape[1] <= 3:
            return sum_by_track(track, values, n_tracks)
        return values[np.searchsorted(track, np.arange(n_tracks))]

    return sum_or_first


def match_once(matcher: QueryMatcher, query: MapQuery, points: np.ndarray, pose: CameraPose, *radius_px: float):
    """The matches that RANSAC agreed with, in place of those of the guided pass."""
    ranked = matcher.rank_frames(query.descriptors)[: map_localizer.CANDIDATES]
    rows, matched = matcher.match_frames(query.descriptors, ranked)
    local = (matcher.map.points[matched] - pose.position) @ pose.rotation
    with np.errstate(divide="ignore", invalid="ignore"):
        off = np.linalg.norm(local[:, :2] / local[:, 2:] - points[rows], axis=1) * query.focal_px
    near = (off <= map_localizer.RANSAC_PX) & (local[:, 2] > 0)
    _, _, seen = MATCH_GUIDED(matcher, query, points, pose, *radius_px)
    return rows[near], matched[near], seen


MATCH_GUIDED = QueryMatcher.match_guided
TINY = 1e-9
"""Standard deviation of what may not move."""

COMPLETE = "nothing left out"


def list_map_steps() -> dict[str, Callable[[], Patches]]:
    """What to replace while a map is built, by the step that is left out."""
    build, match, adjust, tracks = build_map, guided_matching, bundle_adjustment, track_points
    return {
        COMPLETE: list,
        "measured depth (guessed from the poses)": lambda: replace_all(
            build, measure_depth=lambda frames: scene_depth.estimate_depth(frames.rotation, frames.position)
        ),
        "wide baselines (the nearest frames)": lambda: replace_all(build, choose_pairs=choose_nearest),
        "epipolar band": lambda: replace_all(tracks, match_pairs=partial(match.match_pairs, band_px=1e6)),
        "ratio test of pairs": lambda: replace_all(match, RATIO=1.0),
        "size check of pairs": lambda: replace_all(match, SIZE_RATIO=1e6),
        "depth vote": lambda: replace_all(tracks, vote_depths=keep_every_match),
        "one keypoint a frame in a track": lambda: replace_all(tracks, join_tracks=join_connected),
        "4 observations a point (3)": lambda: replace_all(build, MIN_OBSERVATIONS=3),
        "least angle of rays": lambda: replace_all(tracks, MIN_ANGLE_DEG=0.0),
        "mean of descriptors (the first)": lambda: replace_all(
            build, sum_by_track=take_first_descriptor(build.sum_by_track)
        ),
        "offset in adjustment": lambda: replace_all(adjust, OFFSET_SD=(TINY,) * 2),
        "camera in adjustment": lambda: replace_all(adjust, CAMERA_SD_PX=(TINY,) * 2, DISTORTION_SD=TINY),
        "rolling shutter": lambda: replace_all(adjust, READOUT_SD=TINY),
    }


def list_query_steps() -> dict[str, Callable[[], Patches]]:
    """What to replace while images are located, by the step that is left out."""
    query = query_matching
    return {
        "carrying back": lambda: replace_all(GivenPoses, carry_back=lambda self, pose, *turn: pose),
        "candidates (the whole map)": lambda: replace_all(map_localizer, CANDIDATES=10**6),
        "ratio tests of queries": lambda: replace_all(query, MATCH_RATIO=1.0, GUIDED_RATIO=1.0),
        "size check of queries": lambda: replace_all(query, SIZE_OCTAVES=99.0),
        "viewing direction": lambda: replace_all(query, MIN_COSINE=-1.0),
        "guided pass": lambda: replace_all(QueryMatcher, match_guided=match_once),
    }


SETTINGS = {"bundle adjustment": {"bundle_adjust": False}, "validation frames in the map": {"refit": False}}
"""Steps that have a setting of `LandmarkMap`."""


@contextlib.contextmanager
def apply_patches(patches: Patches) -> Iterator[None]:
    with ExitStack() as stack, contextlib.redirect_stdout(io.StringIO()):
        for each in patches:
            stack.enter_context(each)
        yield


def measure_scene(root: str, truth: str, pgt: str | None, only: list[str]) -> list[list[object]]:
    """A row for each step, after the row of all steps."""
    steps = list_map_steps() | list_query_steps()
    complete: FittedMap | None = None
    rows: list[list[object]] = []
    for step in [COMPLETE, *(step for step in only if step != COMPLETE)]:
        try:
            with apply_patches(steps.get(step, list)()):
                fitted = complete if step in list_query_steps() else None
                if fitted is None:
                    adjust = "auto" if complete is None else complete.adjusted
                    settings = {"bundle_adjust": adjust, **SETTINGS.get(step, {})}
                    fitted = fit_map(load_scene(root, truth, pgt), **settings)
                start = time.process_time()
                answers = fitted.locate()
                query_ms = (time.process_time() - start) / len(answers) * 1e3
        except AttributeError as error:  # the package has changed
            print(f"... {step}: not measured, {error}", flush=True)
            continue
        complete = complete or fitted
        errors = fitted.measure(answers)
        rows.append([
            step, truth, errors.medians, f"{np.quantile(errors.position_m, 0.95):.3f}", errors.within_5cm,
            f"{errors.accepted.mean():.0%}", len(fitted.module.network.point_map),
            f"{fitted.cpu_s:.0f}", f"{query_ms:.0f}",
        ])  # fmt: skip
        print("...", *rows[-1], flush=True)
    return rows


def main() -> None:
    """Print the table, as Markdown."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    add_scene_arguments(parser)
    steps = [*list_map_steps(), *SETTINGS, *list_query_steps()]
    parser.add_argument("--only", nargs="+", choices=steps, default=steps, metavar="STEP", help=", ".join(steps))
    args = parser.parse_args()
    rows = [row for truth in find_truths(args) for row in measure_scene(args.root, truth, args.pgt, args.only)]
    head = ["left out", "ground truth", "m / deg", "95 % within m", "5 cm", "accepted", "points", "fit s", "query ms"]
    print_table(head, rows)


if __name__ == "__main__":
    main()
