"""Graphs of nearest neighbours: the search, the edges, and a sample of them.

A graph is a table (N, K) of int64: row i holds the neighbours of node i, nearest first, and `ABSENT` in
the places that stay empty.
"""

from __future__ import annotations

import torch
from torch import Tensor

__all__ = [
    "ABSENT",
    "list_edges",
    "sample_neighbours",
    "search_neighbours",
    "search_within_graph",
]

ABSENT = -1
CHUNK_ELEMENTS = 2**22  # 16 MB


def search_neighbours(
    query: Tensor,
    reference: Tensor,
    k: int,
    query_frame: Tensor | None = None,
    reference_frame: Tensor | None = None,
    gap: int = 1,
    chunk_elements: int = CHUNK_ELEMENTS,
) -> Tensor:
    """Find the k nearest rows of `reference` by L2 for each row of `query`, in chunks of bounded memory.

    Args:
        query: (Q, D).
        reference: (N, D).
        k: how many.
        query_frame: (Q,) places along the trajectory; where given, only reference rows at least `gap` away count.
        reference_frame: (N,) of the same trajectory; needed with `query_frame`.
        gap: 1 keeps a node from being its own neighbour.
        chunk_elements: distances in memory at a time.

    Returns:
        (Q, k) table, nearest first.
    """
    table = torch.full((len(query), k), ABSENT, device=query.device)
    most = min(k, len(reference))
    for rows in torch.arange(len(query), device=query.device).split(max(1, chunk_elements // max(1, len(reference)))):
        distance = torch.cdist(query[rows], reference)
        if query_frame is not None and reference_frame is not None:
            near_in_time = (query_frame[rows, None] - reference_frame).abs() < gap
            distance = distance.masked_fill(near_in_time, torch.inf)
        nearest = distance.topk(most, largest=False)
        table[rows, :most] = nearest.indices.masked_fill(nearest.values.isinf(), ABSENT)
    return table


def search_within_graph(nodes: Tensor, k: int) -> Tensor:
    """Find the k nearest other nodes of the same graph, for B graphs of M nodes at once.

    Args:
        nodes: (B, M, D).
        k: how many; all others where there are fewer.

    Returns:
        (B * M, min(k, M - 1)) table of one graph, with no edges between the B graphs.
    """
    B, M, _ = nodes.shape
    distance = torch.cdist(nodes.detach(), nodes.detach())
    distance.diagonal(dim1=1, dim2=2).fill_(torch.inf)
    nearest = distance.topk(min(k, M - 1), largest=False).indices
    first = torch.arange(0, B * M, M, device=nodes.device)
    return (nearest + first[:, None, None]).flatten(0, 1)


def list_edges(table: Tensor) -> Tensor:
    """Edges (2, E) as PyG reads them: from each neighbour (first row) to its node (second row)."""
    node, place = (table != ABSENT).nonzero(as_tuple=True)
    return torch.stack([table[node, place], node])


def sample_neighbours(table: Tensor, count: int) -> Tensor:
    """Draw up to `count` neighbours of each node without replacement (Hamilton et al., NeurIPS 2017).

    Args:
        table: (N, K).
        count: how many.

    Returns:
        (N, min(count, K)) table.
    """
    places = torch.rand(table.shape, device=table.device).topk(min(count, table.shape[1]), dim=1).indices
    return table.gather(1, places)
