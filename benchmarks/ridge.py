"""Closed forms against scikit-learn: LinearPoseNet and `Ridge`; KernelPoseNet, `KernelRidge` and `Nystroem`.

    python -m benchmarks.ridge [--frames 1000 7000 100000] [--kernel 2000] [--rounds 5]

Rounds of all alternate in one process, on the same 2048 features, each on one thread; CPU seconds count, so that other
work on the machine does not. Ours streams float32 batches, as the data module serves them, and is as exact as float64.
scikit-learn gets the whole matrix at once, in double precision, in which it is as exact as ours. The goal is 0.7 of
its time. Standard error says how far the answers are apart, and what float32 and eight lambdas take.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable, Iterator
from functools import partial
from statistics import median
from typing import Any

import numpy as np
import torch
from sklearn.kernel_approximation import Nystroem
from sklearn.kernel_ridge import KernelRidge
from sklearn.linear_model import Ridge
from threadpoolctl import threadpool_limits

from benchmarks.measurement import Goal, Measurement, Options, format_table
from lightning_pose.models import KernelPoseNet
from lightning_pose.models.parts.refined_ridge import solve_ridges
from lightning_pose.models.parts.ridge import Moments

FRAMES, KERNEL_FRAMES, FEATURES, BATCH = [1000, 7000, 100_000], 2000, 2048, 256
LAMBDA, LAMBDAS = 8.0, [0.5, 1.0, 2.0, 4.0, 8.0, 16.0, 32.0, 64.0]
KERNEL_LAMBDA, GAMMA, LANDMARKS = 3e-3, 0.2, 1000
LIMIT = 0.7
MANY = 50_000
"""Of so many frames, what is not in the table is left out, and there are fewer rounds."""

Work = Callable[[], np.ndarray]


def make_features(frames: int, width: int = FEATURES) -> tuple[torch.Tensor, torch.Tensor]:
    """Positive and correlated, as a CNN's are, of a trajectory with 50 degrees of freedom; and what they tell of it."""
    generator = torch.Generator().manual_seed(0)
    places = torch.randn(frames, 50, generator=generator)
    noise = torch.randn(frames, width, generator=generator)
    x = (places @ torch.randn(50, width, generator=generator) / 50**0.5 + 0.1 * noise).relu_()
    return x, places[:, :7].contiguous()


def solve_ours(x: torch.Tensor, y: torch.Tensor, lambdas: list[float]) -> np.ndarray:
    """(7, D) weights for LAMBDA."""

    def list_batches() -> Iterator[tuple[torch.Tensor, torch.Tensor]]:
        return zip(x.split(BATCH), y.split(BATCH), strict=True)

    moments = Moments(x.shape[1], y.shape[1], torch.float32)
    for batch in list_batches():
        moments.add(*batch)
    return solve_ridges(moments, lambdas, list_batches)[lambdas.index(LAMBDA)].weight.numpy()


def solve_theirs(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """(7, D) weights."""
    return Ridge(LAMBDA, solver="cholesky").fit(x, y).coef_


@torch.no_grad()
def solve_kernel(x: torch.Tensor, y: torch.Tensor, landmarks: int) -> np.ndarray:
    """KernelPoseNet's answers (100, 7) for the first frames; landmarks are evenly spread over the frames."""
    network = KernelPoseNet(input_shape=[x.shape[1]], gamma=GAMMA, landmarks=landmarks).network
    kept = torch.linspace(0, len(x) - 1, min(landmarks, len(x))).round().long()
    network.set_landmarks(x[kept], GAMMA)
    moments = Moments(network.n_lifted, 7)
    for features, poses in zip(x.split(1024), y.split(1024), strict=True):
        moments.add(network.lift(features), poses)
    network.set_solution(moments.ridge([KERNEL_LAMBDA])[0])
    return network(x[:100]).numpy()


def measure_gamma(x: np.ndarray) -> float:
    """scikit-learn's gamma that is KernelPoseNet's: by the median squared distance of a thousand unit vectors."""
    keys = torch.from_numpy(x[:: -(-len(x) // 1000)]).double()
    return GAMMA / float(torch.nn.functional.pdist(keys).square().median())


def normalize(x: np.ndarray) -> np.ndarray:
    return x / np.linalg.norm(x, axis=1, keepdims=True)


def solve_kernel_ridge(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """scikit-learn's answers (100, 7); it has no bias, and gets centred poses."""
    keys, mean = normalize(x), y.mean(0)
    strength: Any = KERNEL_LAMBDA  # scikit-learn's own types say that it is an int
    model = KernelRidge(alpha=strength, kernel="rbf", gamma=measure_gamma(keys)).fit(keys, y - mean)
    return model.predict(keys[:100]) + mean


def solve_nystroem(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """scikit-learn's answers (100, 7), with as many landmarks."""
    keys = normalize(x)
    lift = Nystroem(gamma=measure_gamma(keys), n_components=LANDMARKS, random_state=0).fit(keys)
    model = Ridge(KERNEL_LAMBDA, solver="cholesky").fit(lift.transform(keys), y)
    return model.predict(lift.transform(keys[:100]))


def time_systems(systems: dict[str, Work], rounds: int) -> tuple[dict[str, list[float]], dict[str, np.ndarray]]:
    """CPU seconds of each round but the first, and what each system found."""
    seconds: dict[str, list[float]] = {name: [] for name in systems}
    found: dict[str, np.ndarray] = {}
    with threadpool_limits(1):
        for i in range(rounds + 1):
            for name, work in systems.items():
                start = time.process_time()
                found[name] = work()
                if i:
                    seconds[name].append(time.process_time() - start)
    return seconds, found


def compare(what: str, peer: str, systems: dict[str, Work], rounds: int) -> Measurement:
    """A row for the first system beside the second; a line on standard error for each."""
    seconds, found = time_systems(systems, rounds)
    (ours, theirs), exact = list(seconds.values())[:2], list(found.values())[1]
    for name, times in seconds.items():
        ratio = median(a / b for a, b in zip(times, theirs, strict=True))
        error = np.abs(found[name] - exact).max() / np.abs(exact).max()
        print(
            f"{what}: {name} {median(times):.3f} s, ratio {ratio:.2f}, off by {error:.0e}", file=sys.stderr, flush=True
        )
    ratio = median(a / b for a, b in zip(ours, theirs, strict=True))
    return Measurement(what, median(ours), peer, median(theirs), ratio, Goal("ratio", LIMIT), unit="s CPU")


def measure(options: Options, frames: list[int] = FRAMES, kernel: int = KERNEL_FRAMES) -> Iterator[Measurement]:
    """A row for each number of frames, and one for each peer of KernelPoseNet."""
    torch.set_num_threads(1)
    rounds = options.rounds or 5
    for count in frames:
        x, y = make_features(count)
        x64, y64 = x.double().numpy(), y.double().numpy()
        systems: dict[str, Work] = {
            "ours": partial(solve_ours, x, y, [LAMBDA]),
            "scikit-learn": partial(solve_theirs, x64, y64),
        }
        if count < MANY:
            systems["scikit-learn, float32"] = partial(solve_theirs, x.numpy(), y.numpy())
            systems[f"ours, {len(LAMBDAS)} lambdas"] = partial(solve_ours, x, y, LAMBDAS)
        what = f"LinearPoseNet, {count:,} x {FEATURES}"
        yield compare(what, "scikit-learn `Ridge`, float64", systems, rounds if count < MANY else 1)
    x, y = make_features(kernel)
    x64, y64 = x.double().numpy(), y.double().numpy()
    for landmarks, peer, work in (
        (kernel, "scikit-learn `KernelRidge`", solve_kernel_ridge),
        (LANDMARKS, "scikit-learn `Nystroem` and `Ridge`", solve_nystroem),
    ):
        systems = {"ours": partial(solve_kernel, x, y, landmarks), "scikit-learn": partial(work, x64, y64)}
        what = f"KernelPoseNet, {kernel:,} x {FEATURES}, {landmarks:,} landmarks"
        yield compare(what, peer, systems, rounds)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, nargs="+", default=FRAMES)
    parser.add_argument("--kernel", type=int, default=KERNEL_FRAMES, help="frames for KernelPoseNet")
    parser.add_argument("--rounds", type=int, default=5)
    args = parser.parse_args()
    print(format_table([*measure(Options(rounds=args.rounds), args.frames, args.kernel)]))


if __name__ == "__main__":
    main()
