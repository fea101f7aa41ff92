"""Service: a localizer as the server uses it, from an uploaded image to plain JSON."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

from lightning_pose.serving.uploads import Upload

__all__ = ["Json", "Service"]

Json = Mapping[str, object]
"""A JSON object in plain types."""


@dataclass(frozen=True)
class Service:
    """What the server's addresses answer with.

    Attributes:
        locate: returns `LocatedPose.to_dict()` of an upload; called from several threads.
        model: what `/model` says.
        view: the map from above, see `map_view`; None where the system has none.
    """

    locate: Callable[[Upload], Json]
    model: Json
    view: Json | None = None
