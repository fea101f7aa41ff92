"""Ridge regression as exact as in double precision, from products in single precision, which take half the time."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence

import torch
from torch import Tensor

from lightning_pose.models.parts.chunks import split_rows
from lightning_pose.models.parts.ridge import Moments, Ridge

__all__ = ["Batches", "solve_ridges"]

Batches = Callable[[], Iterable[tuple[Tensor, Tensor]]]
"""Features (B, D) and targets (B, T) of all frames, batch by batch, from the first one at each call."""

SMALL = 1e-5
"""A correction below this share of the weights is the last one: it leaves about its square, and weights are kept in
single precision, which resolves 6e-8."""

SHRINKS = 0.25
"""Corrections that shrink less than by this factor lead nowhere, or take longer than double precision."""


def solve_ridges(moments: Moments, lambdas: Sequence[float], batches: Batches) -> list[Ridge]:
    """Minimise |Y - X W|^2 + lambda |W|^2 for each lambda, in double precision whatever that of the moments.

    Weights from single precision are corrected by iterative refinement (Higham: "Accuracy and Stability of Numerical
    Algorithms", 2nd ed., section 12): the error that they leave is computed from the frames in double precision, and
    solved for with the same factors. Each pass over the frames leaves about 1e-4 of the error before; two are the
    rule. Where that does not converge, as lambda is too small beside the features' squares, the products are
    summed again in double precision.

    Args:
        moments: of all frames.
        lambdas: each above 0.
        batches: the same frames again.
    """
    if moments.dtype == torch.float64:
        return moments.ridge(lambdas)
    solved = _refine(moments, lambdas, batches)
    if solved is None:
        exact = Moments(moments.sizes[0], moments.sizes[1])
        for batch in batches():
            exact.add(*batch)
        return exact.ridge(lambdas)
    return solved


def _refine(moments: Moments, lambdas: Sequence[float], batches: Batches) -> list[Ridge] | None:
    """The solution for each lambda; None if single precision does not lead to it."""
    try:
        equations = moments.make_equations(lambdas)
    except torch.linalg.LinAlgError:  # pyright: ignore[reportPrivateImportUsage]
        return None
    answers = torch.stack([each.solve(each.sides).double() for each in equations])  # (L, D or N, T)
    before = 1.0
    while before > SMALL:
        wrong = _find_residuals(moments, answers, lambdas, batches)
        changes = torch.stack(
            [each.solve(r.to(moments.dtype)).double() for each, r in zip(equations, wrong, strict=True)]
        )
        answers = answers + changes
        size = float((changes.abs().amax((1, 2)) / answers.abs().amax((1, 2)).clamp(min=1e-300)).max())
        if not size < SHRINKS * before:
            return None
        before = size
    return [moments.make_ridge(weight) for weight in _find_weights(moments, answers)]


def _find_residuals(moments: Moments, answers: Tensor, lambdas: Sequence[float], batches: Batches) -> Tensor:
    """What is left of each right-hand side, in double precision: like `answers`, (L, D or N, T)."""
    mean_x, mean_y = moments.mean.split(moments.sizes)
    weight = _find_weights(moments, answers).flatten(0, 1)  # (L * T, D)
    offset = (weight @ mean_x).view(len(answers), -1) - mean_y
    kept = moments.kept()
    products, total = torch.zeros_like(weight), torch.zeros_like(weight[:, :1])
    error = products
    for features, targets in batches() if kept is None else [kept]:
        # (L * T, B): the targets less what the weights predict, both around their means
        error = (targets.double().T + offset[..., None]).flatten(0, 1)
        for rows, x in split_rows(features):
            part = error[:, rows].addmm_(weight, x.T, alpha=-1)
            if kept is None:
                products.addmm_(part, x)
        total += error.sum(1, keepdim=True)
    found = error if kept is not None else products.addmm_(total, mean_x[None], alpha=-1)
    found = found.view(len(answers), -1, found.shape[1]).mT
    return found - torch.tensor(lambdas).to(answers).view(-1, 1, 1) * answers


def _find_weights(moments: Moments, answers: Tensor) -> Tensor:
    """(L, T, D) in double precision."""
    kept = moments.kept()
    if kept is None:
        return answers.mT
    # Of centred features, whose sum over frames is zero.
    centred = (answers - answers.mean(1, keepdim=True)).mT.flatten(0, 1)  # (L * T, N)
    weight = centred.new_zeros(len(centred), moments.sizes[0])
    for rows, x in split_rows(kept[0]):
        weight.addmm_(centred[:, rows], x)
    return weight.view(len(answers), -1, moments.sizes[0])
