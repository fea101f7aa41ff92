"""Graphs of nearest neighbours: known neighbours, bounded memory, edges and samples."""

from __future__ import annotations

import pytest
import torch

from lightning_pose.models.parts.neighbour_graph import (
    ABSENT,
    list_edges,
    sample_neighbours,
    search_neighbours,
    search_within_graph,
)

LINE = torch.tensor([[0.0], [1.0], [3.0], [7.0], [15.0]])


def test_nearest_come_first() -> None:
    table = search_neighbours(torch.tensor([[2.9], [100.0]]), LINE, 3)
    assert table.tolist() == [[2, 1, 0], [4, 3, 2]]


def test_places_that_no_reference_fills_are_absent() -> None:
    assert search_neighbours(LINE[:1], LINE[:2], 3).tolist() == [[0, 1, ABSENT]]
    assert search_neighbours(LINE[:1], LINE[:0], 2).tolist() == [[ABSENT, ABSENT]]
    assert search_neighbours(LINE[:0], LINE, 2).shape == (0, 2)


def test_no_node_is_its_own_neighbour_and_none_within_the_gap() -> None:
    frame = torch.arange(5)
    assert search_neighbours(LINE, LINE, 2, frame, frame).tolist() == [[1, 2], [0, 2], [1, 0], [2, 1], [3, 2]]
    assert search_neighbours(LINE, LINE, 2, frame, frame, gap=3).tolist() == [
        [3, 4],
        [4, ABSENT],
        [ABSENT, ABSENT],
        [0, ABSENT],
        [1, 0],
    ]


def test_chunks_find_the_same_neighbours(monkeypatch: pytest.MonkeyPatch) -> None:
    points = torch.randn(50, 8, generator=torch.Generator().manual_seed(0))
    frame = torch.arange(50)
    whole = search_neighbours(points, points, 4, frame, frame, gap=3)
    rows = []
    measured = torch.cdist
    monkeypatch.setattr(torch, "cdist", lambda a, b: rows.append(len(a)) or measured(a, b))
    assert torch.equal(search_neighbours(points, points, 4, frame, frame, gap=3, chunk_elements=350), whole)
    assert max(rows) == 7
    assert sum(rows) == 50


def test_nodes_of_one_image_are_joined_to_each_other_alone() -> None:
    table = search_within_graph(torch.stack([LINE[:3], LINE[2:]]), 1)
    assert table.tolist() == [[1], [0], [1], [4], [3], [4]]
    assert search_within_graph(LINE[None], 9).shape == (5, 4)


def test_edges_lead_from_neighbours_to_their_node() -> None:
    assert list_edges(torch.tensor([[1, 2], [0, ABSENT]])).tolist() == [[1, 2, 0], [0, 0, 1]]


def test_a_sample_holds_different_neighbours_of_the_node() -> None:
    table = torch.arange(60).view(6, 10)
    torch.manual_seed(0)
    sample = sample_neighbours(table, 4)
    assert sample.shape == (6, 4)
    for row, drawn in zip(table, sample, strict=True):
        assert len(set(drawn.tolist())) == 4
        assert set(drawn.tolist()) <= set(row.tolist())
    assert sample_neighbours(table, 99).sort().values.equal(table)
