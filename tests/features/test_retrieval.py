"""Retrieval vectors of known features, and the order of the nearest."""

from __future__ import annotations

import pytest
import torch

from lightning_pose.errors import ConfigError
from lightning_pose.features.retrieval import compute_global_vectors, find_nearest


def test_global_vectors_have_unit_length_and_a_blank_one_is_zero() -> None:
    train, test = compute_global_vectors(torch.tensor([[3.0, 4.0], [0.0, 0.0]]), torch.tensor([[0.0, 5.0]]))
    torch.testing.assert_close(train, torch.tensor([[0.6, 0.8], [0.0, 0.0]]))
    torch.testing.assert_close(test, torch.tensor([[0.0, 1.0]]))


def test_maps_are_averaged_over_the_image() -> None:
    maps = torch.tensor([[[[1.0, 5.0]], [[8.0, 0.0]]]])
    torch.testing.assert_close(compute_global_vectors(maps, maps)[0], torch.tensor([[0.6, 0.8]]))


def test_nearest_comes_first_and_ties_keep_their_order() -> None:
    reference = torch.tensor([[4.0], [1.0], [-1.0], [9.0]])
    assert find_nearest(torch.tensor([[0.0], [8.0]]), reference, k=3).tolist() == [[1, 2, 0], [3, 0, 1]]
    assert find_nearest(torch.tensor([[0.0]]), reference, k=9).shape == (1, 4)


def test_local_descriptors_become_residuals_to_their_centre() -> None:
    # One distinct descriptor makes one centre, there: training images have no residual, and a query's is its offset.
    train = torch.tensor([[[10.0, 0.0], [10.0, 0.0], [0.0, 0.0]]])
    query = torch.tensor([[[10.0, 1.0], [0.0, 0.0]]])  # one real row, one absent
    own, other = compute_global_vectors(train, query)
    assert own.abs().max() < 1e-6
    torch.testing.assert_close(other, torch.tensor([[0.0, 1.0]]))


def test_layouts_that_differ_are_refused() -> None:
    with pytest.raises(ConfigError, match="give both as"):
        compute_global_vectors(torch.zeros(2, 3), torch.zeros(2, 4))
