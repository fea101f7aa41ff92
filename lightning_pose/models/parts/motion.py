"""Moves of features from one frame of a clip to the next: network input from which poses follow in any scene."""

from __future__ import annotations

import torch
from torch import Tensor

__all__ = ["GEOMETRY_COLUMNS", "MOTION_COLUMNS", "measure_motion"]

MOTION_COLUMNS = 5
GEOMETRY_COLUMNS = 4
LEAST_COSINE = 0.8  # of two descriptors that may be of one point
LONGEST_MOVE = 0.6  # from frame to frame, in half widths of the image


@torch.no_grad()
def measure_motion(features: Tensor) -> Tensor:
    """Match each frame's features to the frame before by mutual nearest descriptors, and measure their moves.

    Args:
        features: (B, T, N, D + 4): descriptors of unit length, then x, y, log size and response, as
            `LocalExtractor` gives them `with_geometry`.

    Returns:
        (B, T, N, 5): x, y, and the changes of x, y and log size; zero rows for features without a match, and for the
        first frame. Rows are in the order of x: the response that sorts features does not depend on where they are.
    """
    descriptors, geometry = features.split([features.shape[-1] - GEOMETRY_COLUMNS, GEOMETRY_COLUMNS], dim=-1)
    similarity = descriptors[:, 1:] @ descriptors[:, :-1].mT
    score, before = similarity.max(-1)
    itself = torch.arange(similarity.shape[-2], device=similarity.device)
    mutual = similarity.argmax(-2).gather(-1, before) == itself
    place = geometry[:, 1:, :, :3]
    move = place - geometry[:, :-1, :, :3].gather(2, before[..., None].expand(*before.shape, 3))
    matched = mutual & (score > LEAST_COSINE) & (move[..., :2].abs().amax(-1) < LONGEST_MOVE)
    rows = torch.cat([place[..., :2], move], dim=-1) * matched[..., None]
    order = torch.where(matched, place[..., 0], torch.inf).argsort(-1)
    rows = rows.gather(2, order[..., None].expand_as(rows))
    return torch.cat([rows.new_zeros(len(rows), 1, *rows.shape[2:]), rows], dim=1)
