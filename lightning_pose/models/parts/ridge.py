"""Ridge regression and principal components in closed form, from one pass over frames of any number."""

from __future__ import annotations

import hashlib
import math
from collections import OrderedDict
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from typing import NamedTuple

import numpy as np
import torch
from scipy.linalg.blas import dsyrk  # pyright: ignore[reportAttributeAccessIssue]
from torch import Tensor

from lightning_pose.errors import ConfigError

__all__ = ["Moments", "Ridge", "Spectrum", "shared_factors"]

_MOST_KEPT = 4  # factorisations: with and without the validation frames, for two kinds of features
_sharing = ContextVar("_sharing", default=False)
_factors: OrderedDict[bytes, tuple[Tensor, Tensor]] = OrderedDict()

_BLOCKS = 8  # of the Gram matrix's columns: the upper triangle takes 36 of 64 products


class Ridge(NamedTuple):
    """A linear map with bias, `targets = features @ weight.T + bias`, in float64.

    Attributes:
        weight: (T, D).
        bias: (T,).
        coefficients: (T, K) of the K principal components that `weight` is folded from; `weight` itself where
            all features are used.
    """

    weight: Tensor
    bias: Tensor
    coefficients: Tensor


class Spectrum(NamedTuple):
    """Principal components of features, in float64, without the null space.

    Attributes:
        values: (R,) eigenvalues of the centred Gram matrix, largest first.
        vectors: (D, R) its eigenvectors.
        mean: (D,) mean features.
    """

    values: Tensor
    vectors: Tensor
    mean: Tensor

    def first(self, components: int) -> Spectrum:
        """The first K of them.

        Raises:
            ConfigError: there are fewer than K.
        """
        if components > len(self.values):
            raise ConfigError(
                f"components is {components}, but the training features have only {len(self.values)} principal "
                "components; give fewer, or more training frames"
            )
        return Spectrum(self.values[:components], self.vectors[:, :components], self.mean)


@contextmanager
def shared_factors() -> Iterator[None]:
    """Within the block, the same features are factorised once, for any number of lambdas and components.

    Factorisations are kept after the block, and found again by the content of the features. It is off by default
    because a single lambda is solved faster without.
    """
    token = _sharing.set(True)
    try:
        yield
    finally:
        _sharing.reset(token)


def _factorise_gram(gram: Tensor) -> tuple[Tensor, Tensor]:
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


def _add_products(gram: Tensor, x: Tensor) -> None:
    """Add x.T @ x, of (N, D) rows, to the upper triangle of (D, D)."""
    if gram.is_cpu:  # half the products of a full one in 0.8 of the time that torch takes for the blocks below
        rows = np.ascontiguousarray(x.numpy())
        dsyrk(
            1.0, rows.T, beta=1.0, c=gram.numpy().T, lower=True, overwrite_c=True
        )  # which is the upper one in C order
        return
    width = -(-len(gram) // _BLOCKS)
    for i in range(0, len(gram), width):
        gram[i : i + width, i:].addmm_(x[:, i : i + width].T, x[:, i:])


class Moments:
    """Count, means and centred second moments of features (D) and targets (T), in float64, from a stream of frames.

    Memory is of the order of D x D, however many frames come. Up to D frames are kept as they are: for so few, the
    products of frames are a smaller problem than those of features. More are folded into the features' Gram matrix,
    around their own mean (Chan, Golub & LeVeque 1983), so that large offsets cost no digits.

    Args:
        n_features: D.
        n_targets: T; 0 where only principal components are wanted.
    """

    def __init__(self, n_features: int, n_targets: int = 0) -> None:
        self._sizes = [n_features, n_targets]
        self._rows = torch.empty(0)  # (D + 1, D + T), of which the first `_n_rows` are not yet folded
        self._n_rows = 0
        self._n_folded = 0
        self._mean = self._gram = self._cross = torch.empty(0)  # of the folded; of the Gram, the upper triangle

    @property
    def count(self) -> int:
        """Frames so far."""
        return self._n_folded + self._n_rows

    def add(self, x: Tensor, y: Tensor) -> None:
        """Add features (B, D) and targets (B, T) of further frames."""
        most = self._sizes[0]
        if not self.count:
            self._rows = x.new_empty(most + 1, sum(self._sizes), dtype=torch.float64)
        while len(x):
            if self._n_rows == most:
                self._fold()
            first, room = self._n_rows, most - self._n_rows
            for part, kept in zip((x, y), self._rows.split(self._sizes, dim=1), strict=True):
                kept[first : first + room][: len(part)] = part[:room]
            self._n_rows += len(x[:room])
            x, y = x[room:], y[room:]

    def all_reduce(self, total: Callable[[Tensor], Tensor]) -> None:
        """Join the moments of several processes, each of one frame or more; `total` sums a tensor over all of them."""
        self._fold()
        count = total(self._mean.new_tensor([self._n_folded]))
        mean = total(self._mean * self._n_folded) / count
        x, y = (self._mean - mean).split(self._sizes)
        self._gram = total(self._gram.addr_(x, x, alpha=self._n_folded))
        self._cross = total(self._cross.addr_(x, y, alpha=self._n_folded))
        self._mean, self._n_folded = mean, int(count)

    def ridge(self, lambdas: Sequence[float], components: int | None = None) -> list[Ridge]:
        """Minimise |Y - X W|^2 + lambda |W|^2 (thesis, eq. 5.2) for each lambda; the bias is not penalised.

        All lambdas and principal components use one eigendecomposition. A single lambda on all features uses a
        Cholesky factorisation, which takes a tenth of the time, except within `shared_factors`.

        Args:
            lambdas: each above 0.
            components: regress on so many principal components (eq. 5.4) instead of all features.

        Raises:
            ConfigError: there are fewer components.
        """
        mean, cross = self._mean_and_cross()
        if components is None and len(lambdas) == 1 and not _sharing.get():
            coefficients, basis = [self._solve_by_cholesky(lambdas[0], cross)], None
        else:
            values, basis, _ = self.spectrum() if components is None else self.spectrum().first(components)
            projected = basis.T @ cross
            coefficients = [(projected / (values + strength)[:, None]).T for strength in lambdas]
        mean_x, mean_y = mean.split(self._sizes)
        answers = []
        for own in coefficients:
            weight = own if basis is None else own @ basis.T
            answers.append(Ridge(weight, mean_y - weight @ mean_x, weight if components is None else own))
        return answers

    def _solve_by_cholesky(self, strength: float, cross: Tensor) -> Tensor:
        """(T, D) weights for one lambda, from the products of features, or of frames while these are fewer."""
        if self._n_folded:
            self._gram.diagonal().add_(strength)
            factor = torch.linalg.cholesky(self._gram, upper=True)
            self._gram.diagonal().sub_(strength)
            return torch.cholesky_solve(cross, factor, upper=True).T
        rows = self._rows[: self._n_rows]
        x, y = (rows - rows.mean(0)).split(self._sizes, dim=1)
        gram = x.new_zeros(len(x), len(x))
        _add_products(gram, x.T)
        gram.diagonal().add_(strength)
        return torch.cholesky_solve(y, torch.linalg.cholesky(gram, upper=True), upper=True).T @ x

    def spectrum(self) -> Spectrum:
        """The principal components of the features, with their sums of squares."""
        if self._n_folded:
            self._fold()
            mean = self._mean
            values, vectors = _factorise_gram(self._gram)
        else:
            rows = self._rows[: self._n_rows]
            mean = rows.mean(0)
            x = (rows - mean)[:, : self._sizes[0]]
            values, vectors = _factorise_gram(x @ x.T)
            # Eigenvectors over frames span those over features, but for what the null space would divide by 0.
            vectors = x.T @ (vectors / values.clamp(min=torch.finfo(values.dtype).tiny).sqrt())
        kept = values > values[-1] * len(values) * torch.finfo(values.dtype).eps
        return Spectrum(values[kept].flip(0), vectors[:, kept].flip(1), mean[: self._sizes[0]])

    def _mean_and_cross(self) -> tuple[Tensor, Tensor]:
        """Mean of features and targets (D + T,), and their centred products (D, T)."""
        if self._n_folded:
            self._fold()
            return self._mean, self._cross
        rows = self._rows[: self._n_rows]
        mean = rows.mean(0)
        x, y = (rows - mean).split(self._sizes, dim=1)
        return mean, (y.T @ x).T

    def _fold(self) -> None:
        """Add the kept rows to the Gram matrix and the products, and forget them."""
        if not self._n_rows:
            return
        features, n, count = self._sizes[0], self._n_rows, self.count
        mean = self._rows[:n].mean(0)
        if not self._n_folded:
            self._mean = torch.zeros_like(mean)
            self._gram, self._cross = mean.new_zeros(features, features), mean.new_zeros(self._sizes)
        shift = mean - self._mean
        self._rows[:n] -= mean
        # One more row makes up for the difference between the two means.
        self._rows[n] = shift * math.sqrt(self._n_folded * n / count)
        x, y = self._rows[: n + 1].split(self._sizes, dim=1)
        _add_products(self._gram, x)
        self._cross += (y.T @ x).T  # a third of the time of x.T @ y
        self._mean = self._mean + shift * (n / count)
        self._n_folded, self._n_rows = count, 0
