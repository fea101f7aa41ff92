"""The landmark map of a growing building: seconds, bytes and memory a frame, and a query's time and error.

    python benchmarks/growth_map.py [--frames 1000 3000 10000] [--threads 1] [--queries 200]

A made building with a room for every 500 frames: points on walls and furniture, 300 keypoints a frame with noise, a
fifth of them clutter, poses that drift by 8 mm and 0.17 degrees. Each size has a process of its own. Stages are those
of `fit`: the map as given, bundle adjustment with new matches between, and the radii. Seconds are CPU seconds. A query
has no features in it. Errors are those of queries from another walk, against their true poses.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable
from typing import TypeVar

import numpy as np
import torch

from benchmarks.made_building import FRAMES_PER_ROOM, make_building, walk_through
from benchmarks.made_frames import ask_process, fit_exponent, peak_rss_gb
from lightning_pose.mapping.build_map import adjust_mapped, map_frames, summarize_tracks
from lightning_pose.mapping.calibration import calibrate_map, measure_answers
from lightning_pose.mapping.map_localizer import MapLocalizer

Found = TypeVar("Found")
STAGES = ("as given", "adjustment", "radii", "load")


def measure(frames: int, threads: int, queries: int) -> dict[str, float]:
    torch.set_num_threads(threads)
    building = make_building(frames // FRAMES_PER_ROOM)
    given, *_ = walk_through(building, FRAMES_PER_ROOM, 0)
    asked, rotation, position = walk_through(building, max(2, 2 * queries // len(building.points)), 1)
    found: dict[str, float] = {"made": peak_rss_gb()}

    def clock(stage: str, work: Callable[[], Found]) -> Found:
        start = time.process_time()
        result = work()
        found[stage] = time.process_time() - start
        print(f"  {stage}: {found[stage]:.1f} s, peak {peak_rss_gb():.2f} GiB", flush=True)
        return result

    plain = clock("as given", lambda: map_frames(given, adjust=False))
    mapped = clock("adjustment", lambda: adjust_mapped(plain, rounds=2))
    clock("radii", lambda: calibrate_map(mapped))
    point_map = summarize_tracks(mapped)
    localizer = clock("load", lambda: MapLocalizer(point_map))
    rows = np.random.default_rng(0).permutation(len(asked))[:queries]
    answers, spent = [], []
    for i in rows:
        query = asked.query(i)
        start = time.process_time()
        answers.append(localizer.locate(query))
        spent.append(time.process_time() - start)
    errors = measure_answers(answers, asked.select(rows).with_poses(rotation[rows], position[rows]))
    return found | {
        "build": found["as given"] + found["adjustment"] + found["radii"],
        "points": len(point_map), "bytes": point_map.n_bytes / frames, "peak": peak_rss_gb(),
        "query": 1000 * float(np.median(spent)), "position": float(np.median(errors.position)),
        "orientation": float(np.median(errors.orientation_deg)), "accepted": float(errors.accepted.mean()),
        "within": float((errors.position <= 0.05).mean()),
    }  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, nargs="+", default=[1000, 3000, 10_000])
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--queries", type=int, default=200)
    parser.add_argument("--one", action="store_true", help="measure in this process, and print JSON")
    args = parser.parse_args()
    if args.one:
        print(json.dumps(measure(args.frames[0], args.threads, args.queries)))
        return
    print(f"| frames | {', '.join(STAGES)} s | s each | points | bytes each | peak GiB | query ms | m / deg | 5 cm |")
    print("|---:|---|---:|---:|---:|---:|---:|---|---:|")
    rows = []
    for frames in args.frames:
        row = ask_process(
            "benchmarks.growth_map", "--frames", frames, "--threads", args.threads, "--queries", args.queries
        )
        rows.append(row)
        print(
            f"| {frames:,d} | {', '.join(f'{row[stage]:.1f}' for stage in STAGES)} | {row['build'] / frames:.4f} "
            f"| {row['points']:,.0f} | {row['bytes']:.0f} | {row['peak']:.2f} | {row['query']:.1f} "
            f"| {row['position']:.4f} / {row['orientation']:.3f} | {row['within']:.1%} |",
            flush=True,
        )
    if len(rows) > 1:
        for name in ("build", "bytes", "peak", "query"):
            values = [
                row[name] * (frames if name == "bytes" else 1) for row, frames in zip(rows, args.frames, strict=True)
            ]
            print(f"exponent of {name}: {fit_exponent(args.frames, values):.2f}")


if __name__ == "__main__":
    main()
