"""Latency at batch 1 on one core, from image file to pose: each checkpoint in torch, and its exported folder.

    python benchmarks/latency.py NAME=CHECKPOINT:FOLDER ... [--images 20] [--rounds 3]

Images are test frames of the checkpoint's run. A model of clips gets them one after the other, as a live camera gives
them. Each system is asked in a process of its own with one thread; the first image is not counted. Prints a Markdown
table of the median over images and rounds, and of a whole process from its start to the first pose. All are CPU time,
which with one thread is the time on an idle core, and does not count what else the computer does.
"""

from __future__ import annotations

import argparse
import os
import resource
import statistics
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

THREADS = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "MKL_NUM_THREADS": "1", "OPENCV_FOR_THREADS_NUM": "1"}


def main() -> None:
    """Measure every pair of the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("systems", nargs="+", metavar="NAME=CHECKPOINT:FOLDER")
    parser.add_argument("--images", type=int, default=20)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--runs", type=int, default=3, help="processes that are timed from their start")
    parser.add_argument("--python", default=sys.executable, help="of an environment without torch, for the folders")
    parser.add_argument("--ask", choices=("torch", "folder"), help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.ask:
        source, *images = args.systems
        print(measure_in_process(args.ask, source, images, args.rounds))
        return
    print("| system | torch ms | exported ms | start to first pose, torch s | exported s | exported bytes |")
    print("|---|---|---|---|---|---|")
    for text in args.systems:
        name, _, paths = text.partition("=")
        checkpoint, _, folder = paths.rpartition(":")
        images = find_images(checkpoint, args.images)
        ask = [__file__, "--rounds", str(args.rounds), "--ask"]
        in_torch = run([sys.executable, *ask, "torch", checkpoint, *images])
        exported = run([args.python, *ask, "folder", folder, *images])
        first = [
            time_process([sys.executable, "-m", "lightning_pose", "localize", checkpoint, images[0]], args.runs),
            time_process([args.python, str(Path(folder) / "localizer.py"), images[0]], args.runs),
        ]
        size = sum(file.stat().st_size for file in Path(folder).iterdir())
        print(f"| {name} | {in_torch} | {exported} | {first[0]:.2f} | {first[1]:.2f} | {size:,} |", flush=True)


def find_images(checkpoint: str, count: int) -> list[str]:
    """Test frames of a checkpoint's run."""
    from lightning_pose.checkpoint import read_checkpoint
    from lightning_pose.export.frames import find_run_frames
    from lightning_pose.localization.trained_system import TrainedSystem

    system, data = TrainedSystem.from_checkpoint(checkpoint), read_checkpoint(checkpoint)["lightning_pose"]["data"]
    return [str(image) for image in find_run_frames(system, data, (), None).images[:count]]


def run(command: list[str]) -> str:
    """What a process prints, which has one thread."""
    found = subprocess.run(command, env={**os.environ, **THREADS}, capture_output=True, text=True, check=True)
    return found.stdout.strip()


def time_process(command: list[str], runs: int) -> float:
    """CPU seconds of a whole process, the least of some runs."""
    seconds = []
    for _ in range(runs):
        before = resource.getrusage(resource.RUSAGE_CHILDREN)
        run(command)
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
        seconds.append(after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime)
    return min(seconds)


def measure_in_process(kind: str, source: str, images: list[str], rounds: int) -> str:
    """Median milliseconds from file to pose."""
    import cv2

    cv2.setNumThreads(1)
    locate = make_locate(kind, source)
    locate(images[0])
    milliseconds = []
    for _ in range(rounds):
        for image in images:
            started = time.process_time()
            locate(image)
            milliseconds.append(1e3 * (time.process_time() - started))
    return f"{statistics.median(milliseconds):.1f}"


def make_locate(kind: str, source: str) -> Callable[[str], object]:
    """A function from a file to its pose."""
    if kind == "folder":
        sys.path.insert(0, source)
        from localizer import Localizer  # pyright: ignore[reportMissingImports]
    else:
        from lightning_pose.localization.localizer import Localizer

    localizer = Localizer.load(source)
    if localizer.system.clips is None:
        return localizer.localize
    follow = localizer.system.start_clip()
    return lambda image: follow(localizer.load_image(image))


if __name__ == "__main__":
    main()
