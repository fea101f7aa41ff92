"""Error and training time of the models of clips against the number of features a frame (thesis, fig. 6.6).

    python benchmarks/clip_features.py [--features 5 20 50 100 300] [--systems cnn_rnn cnn_3d] [--out DIR] [SETTING ...]

Trains every system with every number of features through `fit`, on the configs' synthetic rooms or wherever further
settings say (`--data.root DIR`), in runs of their own. Prints a table, and draws the figure into DIR.
"""

from __future__ import annotations

import argparse
import os
import re
import subprocess
import sys
from pathlib import Path

from mlflow import MlflowClient

from lightning_pose.clip_plots import error_and_time
from lightning_pose.tracking import default_tracking_uri

CONFIGS = Path(__file__).parents[1] / "configs"


def fit(system: str, features: int, settings: list[str]) -> tuple[float, float]:
    """Median position error in metres and training time in seconds of one run."""
    command = [sys.executable, "-m", "lightning_pose", "fit", "--config", str(CONFIGS / f"{system}.yaml")]
    command += ["--data.extractor.n_features", str(features), "--report.log_model", "false"]
    command += ["--report.visual_odometry", "false", *settings]
    done = subprocess.run(command, capture_output=True, text=True, env={**os.environ, "NO_COLOR": "1"})
    if done.returncode:
        sys.exit(f"{' '.join(command)}\n{done.stderr}")
    (run_id,) = re.findall(r"^run (\w+)", done.stdout, re.MULTILINE)
    metrics = MlflowClient(default_tracking_uri()).get_run(run_id).data.metrics
    return metrics["test/position_median_m"], metrics["cost/train_seconds"]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--features", type=int, nargs="+", default=[5, 20, 50, 100, 300])
    parser.add_argument("--systems", nargs="+", default=["cnn_rnn", "cnn_3d"])
    parser.add_argument("--out", type=Path, default=Path("mlruns"))
    args, settings = parser.parse_known_args()
    errors: dict[str, list[float]] = {system: [] for system in args.systems}
    seconds: dict[str, list[float]] = {system: [] for system in args.systems}
    print("features  system     median m  train s")
    for features in args.features:
        for system in args.systems:
            error, time = fit(system, features, settings)
            errors[system].append(error)
            seconds[system].append(time)
            print(f"{features:8d}  {system:9s}  {error:8.3f}  {time:7.1f}", flush=True)
    args.out.mkdir(parents=True, exist_ok=True)
    error_and_time(args.features, errors, seconds).savefig(args.out / "clip_features.png")
    print(args.out / "clip_features.png")


if __name__ == "__main__":
    main()
