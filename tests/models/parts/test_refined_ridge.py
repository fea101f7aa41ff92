"""Ridge regression from products in single precision, against scikit-learn's in double precision."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from functools import partial

import numpy as np
import pytest
import torch
from sklearn.linear_model import Ridge

from lightning_pose.models.parts import refined_ridge
from lightning_pose.models.parts.refined_ridge import solve_ridges
from lightning_pose.models.parts.ridge import Moments

SIZES = {"few frames": (150, 300), "as many as features": (200, 200), "one more": (201, 200), "many frames": (900, 100)}
sizes = pytest.mark.parametrize(("n", "d"), SIZES.values(), ids=SIZES)

Pair = tuple[torch.Tensor, torch.Tensor]


def problem(n: int, d: int) -> Pair:
    """Correlated features and targets, both far from zero."""
    generator = torch.Generator().manual_seed(0)
    x = torch.rand(n, d, generator=generator) @ torch.rand(d, d, generator=generator) + 5
    return x, torch.rand(n, 7, generator=generator).double() + 100


def list_batches(x: torch.Tensor, y: torch.Tensor) -> Iterable[Pair]:
    return zip(x.split(37), y.split(37), strict=True)


def sum_moments(x: torch.Tensor, y: torch.Tensor) -> Moments:
    moments = Moments(x.shape[1], y.shape[1], torch.float32)
    for batch in list_batches(x, y):
        moments.add(*batch)
    return moments


def check(lambdas: list[float], x: torch.Tensor, y: torch.Tensor) -> None:
    """Far more digits than single precision has."""
    solutions = solve_ridges(sum_moments(x, y), lambdas, partial(list_batches, x, y))
    assert len(solutions) == len(lambdas)
    for strength, solution in zip(lambdas, solutions, strict=True):
        theirs = Ridge(strength, solver="cholesky").fit(x.double().numpy(), y.numpy())
        for ours, exact in ((solution.weight, theirs.coef_), (solution.bias, theirs.intercept_)):
            assert ours.dtype == torch.float64
            np.testing.assert_allclose(ours.numpy(), exact, rtol=0, atol=1e-9 * np.abs(exact).max())


@sizes
@pytest.mark.parametrize("lambdas", [[8.0], [4.0, 8.0, 100.0]], ids=["one lambda", "several"])
def test_it_is_scikit_learns_in_double_precision(n: int, d: int, lambdas: list[float]) -> None:
    check(lambdas, *problem(n, d))


@sizes
def test_single_precision_alone_is_not(n: int, d: int) -> None:
    x, y = problem(n, d)
    theirs = Ridge(8.0, solver="cholesky").fit(x.double().numpy(), y.numpy())
    found = sum_moments(x, y).ridge([8.0])[0].weight.numpy()
    assert 1e-8 < np.abs(found - theirs.coef_).max() / np.abs(theirs.coef_).max() < 1e-2


@sizes
@pytest.mark.parametrize("strength", [1e-5, 1e-3], ids=["singular in single precision", "nearly"])
def test_a_small_lambda_is_solved_in_double_precision(
    n: int, d: int, strength: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = []
    monkeypatch.setattr(refined_ridge, "Moments", lambda *sizes: made.append(Moments(*sizes)) or made[-1])
    x, y = problem(n, d)
    x[:, d // 2 :] = x[:, : d // 2]  # linearly dependent
    (solution,) = solve_ridges(sum_moments(x, y), [strength], partial(list_batches, x, y))
    assert [each.dtype for each in made] == [torch.float64]
    exact = Moments(d, 7)
    exact.add(x, y)
    torch.testing.assert_close(solution.weight, exact.ridge([strength])[0].weight, rtol=1e-6, atol=1e-9)


def test_further_frames_change_the_solution() -> None:
    x, y = problem(900, 100)
    moments = sum_moments(x[:80], y[:80])
    solve_ridges(moments, [8.0], partial(list_batches, x[:80], y[:80]))
    for batch in list_batches(x[80:], y[80:]):
        moments.add(*batch)
    (solution,) = solve_ridges(moments, [8.0], partial(list_batches, x, y))
    theirs = Ridge(8.0, solver="cholesky").fit(x.double().numpy(), y.numpy())
    np.testing.assert_allclose(solution.weight.numpy(), theirs.coef_, rtol=0, atol=1e-9 * np.abs(theirs.coef_).max())


def test_equal_frames_leave_the_mean() -> None:
    x, y = torch.ones(4, 5), torch.arange(7.0).double().expand(4, 7)
    (solution,) = solve_ridges(sum_moments(x, y), [1.0], partial(list_batches, x, y))
    torch.testing.assert_close(solution.weight, torch.zeros(7, 5, dtype=torch.float64))
    torch.testing.assert_close(solution.bias, torch.arange(7.0).double())


def test_it_reads_the_frames_few_times() -> None:
    x, y = problem(900, 100)
    read = []

    def batches() -> Iterator[Pair]:
        read.append(1)
        yield from list_batches(x, y)

    solve_ridges(sum_moments(x, y), [8.0, 100.0], batches)
    assert 1 <= len(read) <= 3
