"""Ridge regression and principal components in closed form, from one pass over frames of any number."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from lightning_pose.errors import ConfigError
from lightning_pose.models.parts.chunks import find_mean
from lightning_pose.models.parts.symmetric import Solve, add_products, factorise, find_eigenvectors

__all__ = ["Equations", "Moments", "Ridge", "Spectrum"]


class Equations(NamedTuple):
    """(A + lambda I) Z = B, with products A of features, or of frames while these are fewer.

    Attributes:
        solve: finds Z for any B of the same type.
        sides: B, (D, T) products of features and targets, or (N, T) targets.
        frames: (N, D) centred features; None where the products are of features.
    """

    solve: Solve
    sides: Tensor
    frames: Tensor | None

    def to_weight(self, answer: Tensor) -> Tensor:
        """(T, D) weights from Z."""
        return answer.T if self.frames is None else answer.T @ self.frames.to(answer)


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


class Moments:
    """Count, means and centred second moments of features (D) and targets (T), from a stream of frames.

    Memory is of the order of D x D, however many frames come. Up to D frames are kept as they are: for so few, the
    products of frames are a smaller problem than those of features. More are folded into the features' Gram matrix,
    around their own mean (Chan, Golub & LeVeque 1983), so that large offsets cost no digits.

    Args:
        n_features: D.
        n_targets: T; 0 where only principal components are wanted.
        dtype: of products, and of features that are kept. Single precision takes half the time, and weights are then
            off by some ten-thousandths until `solve_ridges` corrects them. Means and targets are in double precision.

    Attributes:
        sizes: D and T.
    """

    def __init__(self, n_features: int, n_targets: int = 0, dtype: torch.dtype = torch.float64) -> None:
        self.dtype = dtype
        self.sizes = [n_features, n_targets]
        self._x = self._y = torch.empty(0)  # (D + 1, D) and (D + 1, T), of which `_n_rows` are not yet folded
        self._n_rows = 0
        self._rows_mean: Tensor | None = None
        self._n_folded = 0
        self._mean = self._gram = self._cross = torch.empty(0)  # of the folded; of the Gram, the upper triangle

    @property
    def count(self) -> int:
        """Frames so far."""
        return self._n_folded + self._n_rows

    def add(self, x: Tensor, y: Tensor) -> None:
        """Add features (B, D) and targets (B, T) of further frames."""
        most = self.sizes[0]
        if not self.count:
            self._x = x.new_empty(most + 1, most, dtype=self.dtype)
            self._y = x.new_empty(most + 1, self.sizes[1], dtype=torch.float64)
        while len(x):
            if self._n_rows == most:
                self._fold()
            first, room = self._n_rows, most - self._n_rows
            for part, kept in ((x, self._x), (y, self._y)):
                kept[first : first + room][: len(part)] = part[:room]
            self._n_rows += len(x[:room])
            self._rows_mean = None
            x, y = x[room:], y[room:]

    def all_reduce(self, total: Callable[[Tensor], Tensor]) -> None:
        """Join the moments of several processes, each of one frame or more; `total` sums a tensor over all of them."""
        self._fold()
        count = total(self._mean.new_tensor([self._n_folded]))
        mean = total(self._mean * self._n_folded) / count
        x, y = (self._mean - mean).to(self.dtype).split(self.sizes)
        self._gram = total(self._gram.addr_(x, x, alpha=self._n_folded))
        self._cross = total(self._cross.addr_(x, y, alpha=self._n_folded))
        self._mean, self._n_folded = mean, int(count)

    def ridge(self, lambdas: Sequence[float], components: int | None = None) -> list[Ridge]:
        """Minimise |Y - X W|^2 + lambda |W|^2 (thesis, eq. 5.2) for each lambda; the bias is not penalised.

        All lambdas on principal components use one eigendecomposition. One on all features uses a Cholesky
        factorisation, which takes a thirtieth of the time.

        Args:
            lambdas: each above 0.
            components: regress on so many principal components (eq. 5.4) instead of all features.

        Raises:
            ConfigError: there are fewer components.
            LinAlgError: a lambda is too small for the precision.
        """
        if components is None:
            equations = self.make_equations(lambdas)
            return [self.make_ridge(each.to_weight(each.solve(each.sides))) for each in equations]
        spectrum, answers = self.spectrum().first(components), []
        projected = spectrum.vectors.T @ self._find_cross()
        for strength in lambdas:
            coefficients = (projected / (spectrum.values + strength)[:, None]).T
            answers.append(self.make_ridge(coefficients @ spectrum.vectors.T, coefficients))
        return answers

    def make_equations(self, lambdas: Sequence[float]) -> list[Equations]:
        """For each lambda the system of equations whose answer are the weights, factorised.

        Raises:
            LinAlgError: a lambda is too small for the precision.
        """
        if self._n_folded:
            self._fold()
            return [Equations(factorise(self._gram, strength), self._cross, None) for strength in lambdas]
        x, y = self._centre_rows()
        gram = x.new_zeros(len(x), len(x))
        add_products(gram, x.T)
        return [Equations(factorise(gram, strength), y, x) for strength in lambdas]

    def make_ridge(self, weight: Tensor, coefficients: Tensor | None = None) -> Ridge:
        """The map with these (T, D) weights that leaves the mean where it is."""
        mean_x, mean_y = self.mean.split(self.sizes)
        weight = weight.double()
        return Ridge(weight, mean_y - weight @ mean_x, weight if coefficients is None else coefficients)

    @property
    def mean(self) -> Tensor:
        """(D + T,) means of features and targets."""
        if self._n_folded:
            self._fold()
            return self._mean
        return self._find_rows_mean()

    def kept(self) -> tuple[Tensor, Tensor] | None:
        """Features (N, D) and targets (N, T) of all frames; None where there are more than D."""
        return None if self._n_folded else (self._x[: self._n_rows], self._y[: self._n_rows])

    def spectrum(self) -> Spectrum:
        """The principal components of the features, with their sums of squares."""
        mean = self.mean[: self.sizes[0]]
        if self._n_folded:
            values, vectors = find_eigenvectors(self._gram)
        else:
            x, _ = self._centre_rows()
            values, vectors = find_eigenvectors(x @ x.T)
            # Eigenvectors over frames span those over features, but for what the null space would divide by 0.
            vectors = x.T @ (vectors / values.clamp(min=torch.finfo(values.dtype).tiny).sqrt())
        kept = values > values[-1] * len(values) * torch.finfo(values.dtype).eps
        return Spectrum(values[kept].flip(0), vectors[:, kept].flip(1), mean)

    def _find_cross(self) -> Tensor:
        """Centred products (D, T) of features and targets."""
        if self._n_folded:
            self._fold()
            return self._cross
        x, y = self._centre_rows()
        return (y.T @ x).T

    def _find_rows_mean(self) -> Tensor:
        """(D + T,) means of the kept rows, in double precision."""
        if self._rows_mean is None:
            self._rows_mean = torch.cat([find_mean(kept[: self._n_rows]) for kept in (self._x, self._y)])
        return self._rows_mean

    def _centre_rows(self) -> tuple[Tensor, Tensor]:
        """The kept rows less their means, (N, D) and (N, T)."""
        mean_x, mean_y = self._find_rows_mean().split(self.sizes)
        x, y = self._x[: self._n_rows], self._y[: self._n_rows]
        return x - mean_x.to(x), (y - mean_y).to(x)

    def _fold(self) -> None:
        """Add the kept rows to the Gram matrix and the products, and forget them."""
        if not self._n_rows:
            return
        features, n, count = self.sizes[0], self._n_rows, self.count
        mean = self._find_rows_mean()
        if not self._n_folded:
            self._mean = torch.zeros_like(mean)
            self._gram, self._cross = (self._x.new_zeros(features, size) for size in self.sizes)
        shift = mean - self._mean
        # One more row makes up for the difference between the two means.
        for kept, mean_of, shift_of in zip(
            (self._x, self._y), *(s.split(self.sizes) for s in (mean, shift)), strict=True
        ):
            kept[:n] -= mean_of.to(kept)
            kept[n] = shift_of * math.sqrt(self._n_folded * n / count)
        x, y = self._x[: n + 1], self._y[: n + 1].to(self.dtype)
        add_products(self._gram, x)
        self._cross += (y.T @ x).T  # a third of the time of x.T @ y
        self._mean = self._mean + shift * (n / count)
        self._n_folded, self._n_rows = count, 0
