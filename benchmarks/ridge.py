"""Closed-form training on 7000 x 2048 features against scikit-learn's `Ridge(solver="cholesky")`.

    python benchmarks/ridge.py [--frames 7000] [--features 2048] [--batch_size 256] [--rounds 5]

Rounds of all alternate in one process, on the same features, each on one thread; CPU seconds count, so that other work
on the machine does not. Ours streams float32 batches, as the data module serves them, and computes in float64.
scikit-learn gets the whole matrix at once: as float64, in which it is as exact as ours (the goal is a ratio of at most
1), and as float32, in which it is not; the last column says by how much.
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Callable

import numpy as np
import torch
from sklearn.linear_model import Ridge
from threadpoolctl import threadpool_limits

from lightning_pose.models.parts.ridge import Moments

LAMBDA = 8.0
LAMBDAS = [0.5, 1.0, 2.0, 4.0, 8.0, 16.0, 32.0, 64.0]


def features(frames: int, width: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Positive and correlated, as a CNN's are, of a trajectory with 50 degrees of freedom; and what they tell of it."""
    generator = torch.Generator().manual_seed(0)
    places = torch.randn(frames, 50, generator=generator)
    noise = torch.randn(frames, width, generator=generator)
    x = (places @ torch.randn(50, width, generator=generator) / 50**0.5 + 0.1 * noise).relu_()
    return x, places[:, :7].contiguous()


def ours(x: torch.Tensor, y: torch.Tensor, batch_size: int, lambdas: list[float]) -> np.ndarray:
    """(7, D) weights for LAMBDA."""
    moments = Moments(x.shape[1], y.shape[1])
    for batch in zip(x.split(batch_size), y.split(batch_size), strict=True):
        moments.add(*batch)
    return moments.ridge(lambdas)[lambdas.index(LAMBDA)].weight.numpy()


def theirs(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """(7, D) weights."""
    return Ridge(LAMBDA, solver="cholesky").fit(x, y).coef_


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, default=7000)
    parser.add_argument("--features", type=int, default=2048)
    parser.add_argument("--batch_size", type=int, default=256)
    parser.add_argument("--rounds", type=int, default=5)
    args = parser.parse_args()
    torch.set_num_threads(1)
    x, y = features(args.frames, args.features)
    x64, y64 = x.double().numpy(), y.double().numpy()
    systems: dict[str, Callable[[], np.ndarray]] = {
        "scikit-learn, float64": lambda: theirs(x64, y64),
        "scikit-learn, float32": lambda: theirs(x.numpy(), y.numpy()),
        "ours, one lambda": lambda: ours(x, y, args.batch_size, [LAMBDA]),
        f"ours, {len(LAMBDAS)} lambdas": lambda: ours(x, y, args.batch_size, LAMBDAS),
    }
    seconds: dict[str, list[float]] = {name: [] for name in systems}
    weights: dict[str, np.ndarray] = {}
    with threadpool_limits(1):
        for _ in range(args.rounds + 1):
            for name, work in systems.items():
                start = time.process_time()
                weights[name] = work()
                seconds[name].append(time.process_time() - start)
    exact = weights["scikit-learn, float64"]
    base = seconds["scikit-learn, float64"][1:]  # the first round warms up
    print(f"{args.frames} x {args.features}, median of {args.rounds} rounds")
    for name, times in seconds.items():
        ratio = statistics.median(a / b for a, b in zip(times[1:], base, strict=True))
        error = np.abs(weights[name] - exact).max() / np.abs(exact).max()
        print(f"{name:24} {statistics.median(times[1:]):6.3f} s  ratio {ratio:5.2f}  off by {error:.0e}")


if __name__ == "__main__":
    main()
