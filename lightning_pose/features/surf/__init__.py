"""SURF (Bay et al., 2008): `hessian`, on a CPU `strips`, and `detector` find keypoints, `descriptor` describes them.

`numpy_surf` does without torch, and `SURF` is therefore imported on first use.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from lightning_pose.features.surf.extractor import SURF

__all__ = ["SURF"]


def __getattr__(name: str) -> Any:
    """Import `SURF` on its first use (PEP 562)."""
    if name != "SURF":
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from lightning_pose.features.surf.extractor import SURF

    globals()["SURF"] = SURF
    return SURF
