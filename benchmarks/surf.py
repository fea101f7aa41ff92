"""Time of SURF against OpenCV's SIFT: the same frames, interleaved rounds in one run, also beside busy programs.

    python -m benchmarks.surf --images DIR [--n_features 300] [--rounds 5] [--threads 1 2] [--busy 0 2]

Both detect and describe the N strongest features. Without `--images` the frames are made: blurred noise
of many scales, 640 x 480. The ratio is the median over frames and rounds of SURF's time over SIFT's, which has one
thread. `--threads` is what torch is allowed; `--busy` how many loops that never rest run at the same time.
"""

from __future__ import annotations

import argparse
import multiprocessing
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from statistics import median

import cv2
import numpy as np
import torch

from benchmarks.measurement import Goal, Measurement, Options
from lightning_pose.features.surf import SURF

SUFFIXES = {".jpg", ".jpeg", ".png"}
LIMIT = 0.21
"""Of SIFT's time; OpenCV's own SURF, which its packages lack, takes 0.49 of it."""


def read_frames(folder: Path, count: int) -> list[np.ndarray]:
    """`count` grayscale frames, spread evenly over the images in a folder and below it."""
    paths = sorted(p for p in folder.rglob("*") if p.suffix.lower() in SUFFIXES and "depth" not in p.name)
    if not paths:
        raise SystemExit(f"no {', '.join(sorted(SUFFIXES))} images below {folder}; give a folder that has some")
    frames = [cv2.imread(str(p), cv2.IMREAD_GRAYSCALE) for p in paths[:: max(len(paths) // count, 1)][:count]]
    return [frame for frame in frames if frame is not None]


def make_frames(count: int) -> list[np.ndarray]:
    """Textured 640 x 480 frames: noise blurred at many scales."""
    random = np.random.default_rng(0)
    frames = []
    for _ in range(count):
        octaves = [cv2.resize(random.normal(size=(480 >> k, 640 >> k)), (640, 480)) * 2**k for k in range(6)]
        frames.append(cv2.normalize(np.sum(octaves, axis=0), np.zeros(0), 0, 255, cv2.NORM_MINMAX, cv2.CV_8U))
    return frames


def milliseconds(work: Callable[[], object]) -> float:
    start = time.perf_counter()
    work()
    return (time.perf_counter() - start) * 1e3


def spin() -> None:
    """Take a core until the process is ended."""
    while True:
        pass


@contextmanager
def run_busy(count: int) -> Iterator[None]:
    """Keep so many cores busy."""
    loops = [multiprocessing.Process(target=spin, daemon=True) for _ in range(count)]
    for loop in loops:
        loop.start()
    try:
        yield
    finally:
        for loop in loops:
            loop.terminate()
            loop.join()


def time_frames(frames: list[np.ndarray], n_features: int, rounds: int) -> tuple[float, float, float]:
    """Median milliseconds of SIFT and of SURF, and the median ratio."""
    sift, surf = cv2.SIFT.create(n_features), SURF(n_features)
    tensors = [torch.from_numpy(frame)[None] for frame in frames]
    surf(tensors[0])  # the first call builds tables
    pairs = [
        (milliseconds(lambda f=f: sift.detectAndCompute(f, None)), milliseconds(lambda t=t: surf(t)))
        for _ in range(rounds)
        for f, t in zip(frames, tensors, strict=True)
    ]
    sift_ms, surf_ms = (median(column) for column in zip(*pairs, strict=True))
    return sift_ms, surf_ms, median(b / a for a, b in pairs)


def measure(options: Options) -> Iterator[Measurement]:
    """One row: one thread each, frames of `--root` or made ones."""
    cv2.setNumThreads(1)
    torch.set_num_threads(1)
    frames = read_frames(Path(options.root), 20) if options.root else make_frames(20)
    height, width = frames[0].shape
    sift_ms, surf_ms, ratio = time_frames(frames, 300, options.rounds or 5)
    what = f"SURF, 300 features of a frame of {width}x{height}"
    yield Measurement(what, surf_ms, "OpenCV's SIFT", sift_ms, ratio, Goal("ratio", LIMIT), unit="ms")


def main() -> None:
    """Print the median times per frame and their ratio."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--images", type=Path, help="folder of images (default: made frames)")
    parser.add_argument("--frames", type=int, default=20, help="how many of the images to use")
    parser.add_argument("--n_features", type=int, default=300)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--threads", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--busy", type=int, nargs="+", default=[0, 2])
    args = parser.parse_args()

    cv2.setNumThreads(1)
    frames = read_frames(args.images, args.frames) if args.images else make_frames(args.frames)
    height, width = frames[0].shape
    print(f"{len(frames)} frames of {width} x {height}, {args.rounds} rounds, N = {args.n_features}")
    print("| busy loops | threads | SIFT ms | SURF ms | ratio |\n|---|---|---|---|---|")
    for busy in args.busy:
        with run_busy(busy):
            for threads in args.threads:
                torch.set_num_threads(threads)
                sift_ms, surf_ms, ratio = time_frames(frames, args.n_features, args.rounds)
                print(f"| {busy} | {threads} | {sift_ms:.1f} | {surf_ms:.1f} | {ratio:.3f} |", flush=True)


if __name__ == "__main__":
    main()
