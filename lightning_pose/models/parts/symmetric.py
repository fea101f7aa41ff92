"""Symmetric matrices, given by their upper triangles: products of rows, Cholesky factors, and eigenvectors."""

from __future__ import annotations

import hashlib
from collections import OrderedDict
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from functools import partial

import numpy as np
import torch
from scipy.linalg import cho_factor, cho_solve
from scipy.linalg.blas import dsyrk, ssyrk  # pyright: ignore[reportAttributeAccessIssue]
from torch import Tensor

__all__ = ["Solve", "add_products", "factorise", "find_eigenvectors", "shared_factors"]

Solve = Callable[[Tensor], Tensor]
"""What a symmetric system of equations answers to right-hand sides (R, K): (R, K)."""

_MOST_KEPT = 4  # factorisations: with and without the validation frames, for two kinds of features
_sharing = ContextVar("_sharing", default=False)
_factors: OrderedDict[bytes, tuple[Tensor, Tensor]] = OrderedDict()

_BLOCKS = 8  # of the Gram matrix's columns: the upper triangle takes 36 of 64 products


@contextmanager
def shared_factors() -> Iterator[None]:
    """Within the block, the principal components of the same features are computed once, for any number of them.

    They are kept after the block, and found again by the content of the features.
    """
    token = _sharing.set(True)
    try:
        yield
    finally:
        _sharing.reset(token)


def find_eigenvectors(gram: Tensor) -> tuple[Tensor, Tensor]:
    """Eigenvalues, ascending, and eigenvectors of a symmetric matrix, given by its upper triangle."""
    if not _sharing.get():
        return torch.linalg.eigh(gram, UPLO="U")
    key = hashlib.blake2b(gram.contiguous().cpu().numpy().data, digest_size=20).digest()
    if key not in _factors:
        _factors[key] = torch.linalg.eigh(gram, UPLO="U")
        while len(_factors) > _MOST_KEPT:
            _factors.popitem(last=False)
    _factors.move_to_end(key)
    return _factors[key]


def add_products(gram: Tensor, x: Tensor) -> None:
    """Add x.T @ x, of (N, D) rows, to the upper triangle of (D, D)."""
    if gram.is_cpu:  # half the products of a full one in 0.8 of the time that torch takes for the blocks below
        a, multiply = x.numpy(), ssyrk if gram.dtype == torch.float32 else dsyrk
        # In Fortran's order, as these are in BLAS, C's upper triangle is the lower one.
        a, of_columns = (a, True) if a.flags.f_contiguous else (np.ascontiguousarray(a).T, False)
        multiply(1.0, a, beta=1.0, c=gram.numpy().T, trans=of_columns, lower=True, overwrite_c=True)
        return
    width = -(-len(gram) // _BLOCKS)
    for i in range(0, len(gram), width):
        gram[i : i + width, i:].addmm_(x[:, i : i + width].T, x[:, i:])


def factorise(gram: Tensor, strength: float) -> Solve:
    """How to solve systems of a symmetric matrix, given by its upper triangle, with `strength` more on its diagonal.

    Raises:
        LinAlgError: rounding has left a matrix that is not positive definite.
    """
    whole = gram.clone()
    whole.diagonal().add_(strength)
    if not gram.is_cpu:
        return partial(_solve_with, torch.linalg.cholesky(whole, upper=True))
    try:  # in place, in a third of the time that torch takes
        factor = cho_factor(whole.numpy().T, lower=True, overwrite_a=True, check_finite=False)
    except np.linalg.LinAlgError as error:
        raise torch.linalg.LinAlgError(str(error)) from error  # pyright: ignore[reportPrivateImportUsage]
    return lambda sides: torch.from_numpy(cho_solve(factor, sides.numpy(), check_finite=False))


def _solve_with(factor: Tensor, sides: Tensor) -> Tensor:
    return torch.cholesky_solve(sides, factor, upper=True)
