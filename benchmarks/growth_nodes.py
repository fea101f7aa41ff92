"""NodePose at 1,000 to 1,000,000 training images with made features: seconds, memory, and the recall of the search.

    python benchmarks/growth_nodes.py [--nodes 1000 10000 100000 1000000] [--features 64] [--epochs 2]

Each number of images has a process of its own, for its peak memory. Seconds are CPU seconds of one thread: of the
neighbour search among all images, and of the last epoch's steps. Recall is the part of the true 30 nearest of 500
images that the search has found. The error is the median of validation frames after these epochs. The last line has the
exponents of growth from the first number of images to the last.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from pathlib import Path

import torch
from lightning import Trainer
from torch.nn import functional as F

from benchmarks.made_frames import EpochClock, MadeFrames, MadeVectors, ask_process, fit_exponent, peak_rss_gb
from lightning_pose.data.batches import PoseBatch
from lightning_pose.models import NodePose
from lightning_pose.models.parts.neighbour_graph import search_neighbours

SETTINGS = {"neighbours": 30, "aggr": "mean", "standardize_features": False, "learning_rate": 0.0013, "slope": 1.0}


class TimedNodePose(NodePose):
    """Keeps the CPU seconds that the search of all neighbours takes."""

    search_seconds = 0.0

    def store_training(self, train: PoseBatch) -> None:
        start = time.process_time()
        super().store_training(train)
        self.search_seconds = time.process_time() - start


def measure(nodes: int, width: int, epochs: int, limit: int) -> dict[str, float]:
    torch.set_num_threads(1)
    torch.manual_seed(0)
    with tempfile.TemporaryDirectory() as folder:
        data = MadeFrames(MadeVectors(width), nodes, 1024, Path(folder))
        model = TimedNodePose(input_shape=[width], full_graph_limit=limit, **SETTINGS)
        clock = EpochClock()
        trainer = Trainer(
            max_epochs=epochs, accelerator="cpu", callbacks=[clock], logger=False, enable_checkpointing=False,
            enable_progress_bar=False, enable_model_summary=False, num_sanity_val_steps=0,
        )  # fmt: skip
        start = time.process_time()
        trainer.fit(model, datamodule=data)
        total = time.process_time() - start
        error = float(trainer.callback_metrics["val/position_median_m"])
        keys = F.normalize(model.memory_features, dim=-1)
        sample = torch.randperm(nodes)[:500]
        frame = model.memory_frame
        exact = search_neighbours(keys[sample], keys, 30, frame[sample], frame)
        found = model.memory_table[sample]
        recall = (found[:, :, None] == exact[:, None]).any(2).float().mean()
    found = {"search": model.search_seconds, "recall": float(recall), "epoch": clock.seconds[-1], "all": total}
    return found | {"GiB": peak_rss_gb(), "error": error}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--nodes", type=int, nargs="+", default=[1000, 10_000, 100_000, 1_000_000])
    parser.add_argument("--features", type=int, default=64)
    parser.add_argument("--epochs", type=int, default=2)
    parser.add_argument("--full_graph_limit", type=int, default=10_000)
    parser.add_argument("--one", action="store_true", help="measure in this process, and print JSON")
    args = parser.parse_args()
    if args.one:
        print(json.dumps(measure(args.nodes[0], args.features, args.epochs, args.full_graph_limit)))
        return
    print("   images  search s  recall  epoch s  all s  peak GiB  error m")
    rows = []
    for nodes in args.nodes:
        words = ["--features", args.features, "--epochs", args.epochs, "--full_graph_limit", args.full_graph_limit]
        row = ask_process("benchmarks.growth_nodes", "--nodes", nodes, *words)
        rows.append(row)
        print(
            f"{nodes:9,d}  {row['search']:8.1f}  {row['recall']:.3f}  {row['epoch']:7.2f}  {row['all']:5.0f}"
            f"  {row['GiB']:8.2f}  {row['error']:7.3f}",
            flush=True,
        )
    if len(rows) > 1:
        grown = {name: fit_exponent(args.nodes, [row[name] for row in rows]) for name in ("search", "epoch", "GiB")}
        print("exponents: " + ", ".join(f"{name} {value:.2f}" for name, value in grown.items()))


if __name__ == "__main__":
    main()
