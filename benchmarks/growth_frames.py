"""Training on features that need not fit memory: seconds and memory by the number of frames, features made.

    python benchmarks/growth_frames.py [--frames 2000 20000 200000] [--models LinearPoseNet DensePoseNet SurfLSTM]

LinearPoseNet and DensePoseNet read 1,280 numbers a frame, SurfLSTM 75 descriptors of 64, one epoch. Each training has a
process of its own. Seconds are CPU seconds of one thread, of `fit` without making the features. `own` is the most
memory that the process had for itself, and `peak` includes the pages of the features' file that happened to be in
memory; the system takes those back when it needs them. To see that it does, run it where memory is limited, such as

    systemd-run --scope -p MemoryMax=4G python benchmarks/growth_frames.py

--units is the width of SurfLSTM, which costs time, and no memory to speak of.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import threading
import time
from pathlib import Path

import psutil
import torch
from lightning import Trainer

from benchmarks.made_frames import MadeFrames, MadeVectors, ask_process, fit_exponent, peak_rss_gb
from lightning_pose import models
from lightning_pose.features import SURF

MODELS = ("LinearPoseNet", "DensePoseNet", "SurfLSTM")


class OwnMemory(threading.Thread):
    """Notes the most memory that this process has for itself: resident, and not of a file."""

    gib = 0.0

    def __init__(self) -> None:
        super().__init__(daemon=True)
        self.start()

    def run(self) -> None:
        process = psutil.Process()
        while True:
            memory = process.memory_info()
            self.gib = max(self.gib, (memory.rss - memory.shared) / 2**30)
            time.sleep(0.05)


def measure(name: str, frames: int, units: int, folder: str | None) -> dict[str, float]:
    torch.set_num_threads(1)
    torch.manual_seed(0)
    extractor = SURF(n_features=75) if name == "SurfLSTM" else MadeVectors(1280)
    settings = {"cell": "gru", "layers": 1, "units": units} if name == "SurfLSTM" else {}
    with tempfile.TemporaryDirectory(dir=folder) as scratch:
        data = MadeFrames(extractor, frames, 256, Path(scratch))
        features = data.dataset("train").data.features
        memory = OwnMemory()
        model = getattr(models, name)(input_shape=list(data.input_shape), **settings)
        trainer = Trainer(
            max_epochs=1, accelerator="cpu", logger=False, enable_checkpointing=False, enable_progress_bar=False,
            enable_model_summary=False, num_sanity_val_steps=0,
        )  # fmt: skip
        start = time.process_time()
        trainer.fit(model, datamodule=data)
        seconds = time.process_time() - start
    return {
        "GiB": features.nbytes / 2**30, "seconds": seconds, "own": memory.gib, "peak": peak_rss_gb(),
        "error": float(trainer.callback_metrics["val/position_median_m"]),
    }  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, nargs="+", default=[2000, 20_000, 200_000])
    parser.add_argument("--models", nargs="+", choices=MODELS, default=list(MODELS))
    parser.add_argument("--units", type=int, default=150)
    parser.add_argument("--folder", help="on the disk for the features (default: the system's for temporary files)")
    parser.add_argument("--one", action="store_true", help="measure in this process, and print JSON")
    args = parser.parse_args()
    if args.one:
        print(json.dumps(measure(args.models[0], args.frames[0], args.units, args.folder)))
        return
    print("model            frames  features GiB  fit s  own GiB  peak GiB  error m")
    for name in args.models:
        rows = []
        for frames in args.frames:
            words = ["--models", name, "--frames", frames, "--units", args.units]
            words += ["--folder", args.folder] if args.folder else []
            row = ask_process("benchmarks.growth_frames", *words)
            rows.append(row)
            print(
                f"{name:14s} {frames:8,d}  {row['GiB']:12.2f}  {row['seconds']:5.0f}  {row['own']:7.2f}"
                f"  {row['peak']:8.2f}  {row['error']:7.3f}",
                flush=True,
            )
        if len(rows) > 1:
            print(f"{name}: seconds grow with an exponent of", end=" ")
            print(f"{fit_exponent(args.frames, [row['seconds'] for row in rows]):.2f}")


if __name__ == "__main__":
    main()
