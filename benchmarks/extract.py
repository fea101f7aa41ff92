"""Filling the feature cache: two workers against one, and a CNN's features against a bare torch loop.

    python -m benchmarks.extract [--frames 300] [--rounds 5] [--root DIR]

Images are frames of a synthetic room, 640x480, or of `--root`. Each measurement fills an empty cache, as `extract`
does: it reads, hashes and decodes files, extracts, and writes records. Two workers should be 1.8 times as fast as one
in wall time, which takes two idle cores. The bare loop decodes, resizes, crops and runs the same network in batches of
the same size, with one thread; one worker should take at most 1.05 of its time.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import torch
from torch.nn import functional as F

from benchmarks.measurement import Goal, Measurement, Options, Seconds, format_table, interleave, time_work
from lightning_pose.features import CNN, SURF, FeatureCache, FeatureExtractor
from lightning_pose.features.fill_job import BATCH
from lightning_pose.scenes.synthetic import render_room

SUFFIXES = {".jpg", ".jpeg", ".png"}
SPEED_UP, OVERHEAD = 1.8, 1.05
FRAMES = 300


def list_images(root: Path, count: int) -> list[Path]:
    """So many images, evenly spread over those of a folder and below it.

    Raises:
        SystemExit: there are none.
    """
    paths = sorted(p for p in root.rglob("*") if p.suffix.lower() in SUFFIXES and "depth" not in p.name)
    if not paths:
        raise SystemExit(f"no {', '.join(sorted(SUFFIXES))} images below {root}; give a folder that has some")
    return paths[:: max(len(paths) // count, 1)][:count]


def fill_cache(extractor: FeatureExtractor, paths: list[Path], workers: int) -> Seconds:
    """Extract the features of images into an empty cache."""
    with tempfile.TemporaryDirectory() as root:
        return time_work(lambda: FeatureCache(extractor, root).fill(paths, workers, progress=False))


@torch.inference_mode()
def run_bare(cnn: CNN, network: torch.nn.Module, paths: list[Path]) -> list[torch.Tensor]:
    """(B, C) features of each batch of images, in a loop written by hand."""
    found = []
    for start in range(0, len(paths), BATCH):
        batch = []
        for path in paths[start : start + BATCH]:
            image = np.asarray(cv2.imread(str(path)))[:, :, ::-1].copy()
            height, width = image.shape[:2]
            scale = cnn.short_side / min(height, width)
            rgb = torch.from_numpy(image).permute(2, 0, 1)[None].float() / 255
            rgb = F.interpolate(rgb, (round(height * scale), round(width * scale)), mode="bilinear", antialias=True)
            top, left = (rgb.shape[2] - cnn.side) // 2, (rgb.shape[3] - cnn.side) // 2
            batch.append(rgb[0, :, top : top + cnn.side, left : left + cnn.side])
        features = network(torch.stack(batch).to(memory_format=torch.channels_last))
        found.append(features.mean((2, 3)) if features.ndim == 4 else features)
    return found


def measure(options: Options, frames: int = FRAMES) -> Iterator[Measurement]:
    """Two rows of workers, SURF and CNN, and one of the CNN against the bare loop."""
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    with tempfile.TemporaryDirectory() as folder:
        root = Path(options.root or render_room(Path(folder) / "room", frames=frames, size=(640, 480)))
        paths, surf, cnn = list_images(root, frames), SURF(300), CNN("efficientnet_lite0", weights="none")
        network = cnn.load_network()
        one, two = "one worker", "two workers"
        found = {}
        for name, extractor in (("SURF, 300 features", surf), ("EfficientNet-Lite0", cnn)):
            systems: dict[str, Callable[[], Seconds]] = {
                words: partial(fill_cache, extractor, paths, n) for n, words in ((1, one), (2, two))
            }
            if extractor is cnn:
                systems["bare"] = lambda: time_work(lambda: run_bare(cnn, network, paths))
            found[name] = interleave(systems, options.rounds or 5)
            what = f"`extract` of {len(paths)} images by two workers, {name}"
            yield Measurement.from_rounds(
                what, found[name][two], one, found[name][one], Goal("ratio", SPEED_UP, at_least=True)
            )
    what, seconds = f"CNN features of {len(paths)} images through the cache, EfficientNet-Lite0", found[name]
    yield Measurement.from_rounds(what, seconds[one], "bare torch loop", seconds["bare"], Goal("ratio", OVERHEAD))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--root", help="folder of images (default: a synthetic room)")
    parser.add_argument("--frames", type=int, default=FRAMES)
    parser.add_argument("--rounds", type=int, default=5)
    args = parser.parse_args()
    print(format_table([*measure(Options(args.root, rounds=args.rounds), args.frames)]))


if __name__ == "__main__":
    main()
