"""Where features moved from one frame of a clip to the next: input from which relative poses follow in any scene."""

from __future__ import annotations

import torch
from torch import Tensor

__all__ = ["GEOMETRY_COLUMNS", "MOTION_COLUMNS", "matched_motion"]

MOTION_COLUMNS = 5
GEOMETRY_COLUMNS = 4
ALIKE = 0.8  # cosine of two descriptors that may be of one point
FARTHEST = 0.6  # move from frame to frame, in half widths of the image


@torch.no_grad()
def matched_motion(features: Tensor) -> Tensor:
    """Moves of the features of each frame since the frame before, by mutual nearest descriptors.

    Args:
        features: (B, T, N, D + 4): descriptors of unit length, then x, y, log size and response, as
            `LocalExtractor` gives them `with_geometry`.

    Returns:
        (B, T, N, 5): x, y, and the changes of x, y and log size; zero rows for features without a match, and for the
        first frame. Rows are in the order of x: the response that sorts features says nothing of where they are.
    """
    descriptors, geometry = features.split([features.shape[-1] - GEOMETRY_COLUMNS, GEOMETRY_COLUMNS], dim=-1)
    alike = descriptors[:, 1:] @ descriptors[:, :-1].mT
    score, before = alike.max(-1)
    itself = torch.arange(alike.shape[-2], device=alike.device)
    mutual = alike.argmax(-2).gather(-1, before) == itself
    place = geometry[:, 1:, :, :3]
    move = place - geometry[:, :-1, :, :3].gather(2, before[..., None].expand(*before.shape, 3))
    matched = mutual & (score > ALIKE) & (move[..., :2].abs().amax(-1) < FARTHEST)
    rows = torch.cat([place[..., :2], move], dim=-1) * matched[..., None]
    order = torch.where(matched, place[..., 0], torch.inf).argsort(-1)
    rows = rows.gather(2, order[..., None].expand_as(rows))
    return torch.cat([torch.zeros_like(rows[:, :1]), rows], dim=1)
