"""SURF (Bay et al., 2008) in batched torch: `hessian` and `detector` find keypoints, `descriptor` describes them."""

from lightning_pose.features.surf.extractor import SURF

__all__ = ["SURF"]
