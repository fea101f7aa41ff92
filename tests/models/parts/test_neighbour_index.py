"""NeighbourIndex: approximate neighbours are nearly the true ones, and keep the rules of the exact search."""

from __future__ import annotations

import pytest
import torch

from lightning_pose.models.parts import neighbour_index
from lightning_pose.models.parts.neighbour_graph import ABSENT, search_neighbours
from lightning_pose.models.parts.neighbour_index import NeighbourIndex

POINTS = torch.randn(600, 8, generator=torch.Generator().manual_seed(0))
FRAME = torch.arange(600)


@pytest.fixture
def approximate() -> NeighbourIndex:
    pytest.importorskip("faiss", reason="`uv sync --extra large` installs faiss")
    index = NeighbourIndex(POINTS, exact_limit=100)
    assert not index.exact
    return index


@pytest.mark.parametrize("gap", [1, 4])
def test_nearly_all_true_neighbours_are_found_nearest_first_and_none_within_the_gap(
    gap: int, approximate: NeighbourIndex
) -> None:
    found = approximate.search(POINTS, 5, FRAME, FRAME, gap)
    exact = search_neighbours(POINTS, POINTS, 5, FRAME, FRAME, gap)
    assert (found == exact).float().mean() > 0.97
    assert ((found - FRAME[:, None]).abs() >= gap).all()
    assert NeighbourIndex(POINTS, exact_limit=100).search(POINTS, 5, FRAME, FRAME, gap).equal(found), "always the same"


def test_queries_are_searched_without_frames_and_empty_places_are_absent(approximate: NeighbourIndex) -> None:
    query = POINTS[:7] + 0.001
    assert (approximate.search(query, 3)[:, 0] == torch.arange(7)).all()
    few = NeighbourIndex(POINTS[:3], exact_limit=2)
    assert few.search(query, 5, FRAME[:7], FRAME[:3])[:, 2:].eq(ABSENT).all(dim=0).tolist() == [False, True, True]
    assert few.search(query[:1], 2, FRAME[:1], FRAME[:3], gap=9).tolist() == [[ABSENT, ABSENT]]


def test_without_faiss_all_are_compared_and_a_line_says_so(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(neighbour_index, "find_spec", lambda name: None)
    index = NeighbourIndex(POINTS, exact_limit=100)
    assert index.exact
    assert "`uv sync --extra large` installs faiss" in caplog.text
    assert index.search(POINTS, 4, FRAME, FRAME).equal(search_neighbours(POINTS, POINTS, 4, FRAME, FRAME))
