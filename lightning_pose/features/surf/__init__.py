"""SURF (Bay et al., 2008): `hessian`, on a CPU `strips`, and `detector` find keypoints, `descriptor` describes them."""

from lightning_pose.features.surf.extractor import SURF

__all__ = ["SURF"]
