"""Closed-form ridge regression and principal components, against scikit-learn's."""

from __future__ import annotations

import threading

import numpy as np
import pytest
import torch
from sklearn.decomposition import PCA
from sklearn.linear_model import Ridge
from sklearn.pipeline import make_pipeline

from lightning_pose.errors import ConfigError
from lightning_pose.models.parts.ridge import Moments
from lightning_pose.models.parts.symmetric import shared_factors

SIZES = {"few frames": (60, 90), "as many as features": (80, 80), "one more": (81, 80), "many frames": (700, 50)}
sizes = pytest.mark.parametrize(("n", "d"), SIZES.values(), ids=SIZES)


def problem(n: int, d: int) -> tuple[np.ndarray, np.ndarray]:
    """Correlated features far from zero, as float32, and targets farther."""
    rng = np.random.default_rng(0)
    x = rng.random((n, d)) @ rng.random((d, d)) + 5
    return x.astype(np.float32), (rng.random((n, 7)) + 100).astype(np.float32)


def moments(x: np.ndarray, y: np.ndarray, batch: int = 37) -> Moments:
    taken = Moments(x.shape[1], y.shape[1])
    for part in zip(torch.from_numpy(x).split(batch), torch.from_numpy(y).split(batch), strict=True):
        taken.add(*part)
    return taken


def check(ours: torch.Tensor, theirs: np.ndarray) -> None:
    np.testing.assert_allclose(ours.numpy(), theirs, rtol=0, atol=1e-5 * np.abs(theirs).max())


@sizes
@pytest.mark.parametrize("lambdas", [[8.0], [0.5, 8.0, 100.0]])
def test_ridge_is_scikit_learns(n: int, d: int, lambdas: list[float]) -> None:
    x, y = problem(n, d)
    solutions = moments(x, y).ridge(lambdas)
    assert len(solutions) == len(lambdas)
    for strength, solution in zip(lambdas, solutions, strict=True):
        theirs = Ridge(strength, solver="cholesky").fit(x.astype(float), y.astype(float))
        check(solution.weight, theirs.coef_)
        check(solution.bias, theirs.intercept_)
        assert solution.coefficients is solution.weight


@sizes
def test_principal_components_are_scikit_learns(n: int, d: int) -> None:
    x, y = problem(n, d)
    spectrum = moments(x, y).spectrum()
    theirs = PCA(10, svd_solver="full").fit(x.astype(float))
    signs = np.sign((spectrum.vectors.T[:10].numpy() * theirs.components_).sum(1, keepdims=True))
    check(spectrum.vectors.T[:10], signs * theirs.components_)
    check(spectrum.values[:10] / (n - 1), theirs.explained_variance_)
    check(spectrum.mean, theirs.mean_)
    assert len(spectrum.values) == min(n - 1, d)


@sizes
def test_ridge_on_components_is_scikit_learns(n: int, d: int) -> None:
    x, y = problem(n, d)
    (solution,) = moments(x, y).ridge([2.0], components=10)
    theirs = Ridge(2.0)
    whole = make_pipeline(PCA(10, svd_solver="full"), theirs).fit(x.astype(float), y.astype(float))
    check(torch.from_numpy(x).double() @ solution.weight.T + solution.bias, whole.predict(x.astype(float)))
    check(solution.coefficients.abs(), np.abs(theirs.coef_))  # type: ignore[attr-defined]


@sizes
def test_asking_changes_nothing_and_more_frames_can_follow(n: int, d: int) -> None:
    x, y = problem(n, d)
    half = n // 2
    taken = moments(x[:half], y[:half])
    first = taken.ridge([8.0])[0].weight
    torch.testing.assert_close(taken.ridge([8.0])[0].weight, first, rtol=0, atol=0)
    taken.add(torch.from_numpy(x[half:]), torch.from_numpy(y[half:]))
    assert taken.count == n
    check(taken.ridge([8.0])[0].weight, Ridge(8.0).fit(x.astype(float), y.astype(float)).coef_)


@sizes
def test_processes_join_their_sums(n: int, d: int) -> None:
    x, y = problem(n, d)
    parts = [moments(x[: n // 3], y[: n // 3]), moments(x[n // 3 :], y[n // 3 :])]
    _all_reduce(parts)
    theirs = Ridge(8.0).fit(x.astype(float), y.astype(float))
    for part in parts:
        assert part.count == n
        for lambdas in ([8.0], [8.0, 1.0]):
            check(part.ridge(lambdas)[0].weight, theirs.coef_)
            check(part.ridge(lambdas)[0].bias, theirs.intercept_)


def _all_reduce(parts: list[Moments]) -> None:
    """Each part in a thread of its own, as in a process of its own."""
    barrier, given = threading.Barrier(len(parts)), [torch.empty(0)] * len(parts)

    def reduce(rank: int) -> None:
        def total(own: torch.Tensor) -> torch.Tensor:
            given[rank] = own.clone()
            barrier.wait()
            answer = torch.stack(given).sum(0)
            barrier.wait()
            return answer

        parts[rank].all_reduce(total)

    threads = [threading.Thread(target=reduce, args=(rank,)) for rank in range(len(parts))]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(timeout=60)


def test_large_offsets_cost_no_digits() -> None:
    x, y = problem(700, 50)
    x, y = x.astype(float), y.astype(float)
    near, far = moments(x, y).ridge([8.0])[0], moments(x + 1e6, y + 1e6).ridge([8.0])[0]
    torch.testing.assert_close(far.weight, near.weight, rtol=1e-6, atol=1e-8)


def test_memory_does_not_grow_with_the_frames() -> None:
    taken = Moments(20, 7)
    sizes = []
    for _ in range(3):
        for _ in range(50):
            taken.add(torch.randn(8, 20), torch.randn(8, 7))
        sizes.append(sum(value.numel() for value in vars(taken).values() if isinstance(value, torch.Tensor)))
    assert max(sizes) <= 20 * 20 + 20 * 7 + 27 + 21 * 27


def test_equal_frames_leave_the_mean() -> None:
    taken = Moments(5, 7)
    taken.add(torch.ones(4, 5), torch.arange(7.0).expand(4, 7))
    for solution in taken.ridge([1.0, 2.0]):
        torch.testing.assert_close(solution.weight, torch.zeros(7, 5, dtype=torch.float64))
        torch.testing.assert_close(solution.bias, torch.arange(7.0).double())


@sizes
def test_more_components_than_there_are_is_refused(n: int, d: int) -> None:
    x, y = problem(n, d)
    rank = min(n - 1, d)
    with pytest.raises(ConfigError, match=f"components is 1000, .* only {rank} principal components; give fewer"):
        moments(x, y).ridge([1.0], components=1000)


@pytest.mark.parametrize("frames", [30, 90], ids=["fewer frames than features", "more"])
def test_shared_factors_factorise_once_and_solve_the_same(frames: int, monkeypatch: pytest.MonkeyPatch) -> None:
    torch.manual_seed(0)
    x, y = torch.randn(frames, 40).double(), torch.randn(frames, 3).double()

    def moments() -> Moments:
        made = Moments(40, 3)
        made.add(x, y)
        return made

    alone = [moments().ridge([1.0], components=components)[0] for components in (5, 7)]
    factorised = []
    eigh = torch.linalg.eigh
    monkeypatch.setattr(torch.linalg, "eigh", lambda *args, **kwargs: factorised.append(1) or eigh(*args, **kwargs))
    shared = []
    for components in (5, 7):
        with shared_factors():  # as the trials of a study are: one after the other
            shared += moments().ridge([1.0], components)
    assert len(factorised) == 1
    for ours, theirs in zip(shared, alone, strict=True):
        torch.testing.assert_close(ours, theirs)


def test_other_features_are_factorised_anew() -> None:
    solved = []
    for seed in (0, 1, 0):
        torch.manual_seed(seed)
        moments = Moments(5, 2)
        moments.add(torch.randn(20, 5).double(), torch.randn(20, 2).double())
        with shared_factors():
            solved += moments.ridge([1.0], components=3)
    torch.testing.assert_close(solved[0], solved[2])
    assert not torch.allclose(solved[0].weight, solved[1].weight)
