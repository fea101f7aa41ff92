"""Images to features: our own SURF, other descriptors from OpenCV, frozen CNNs, pixels, and the feature cache.

`base` describes how to add an extractor.
"""

from lightning_pose.features.base import FeatureExtractor, LocalExtractor
from lightning_pose.features.cache import FeatureCache, FillReport
from lightning_pose.features.cnn import CNN
from lightning_pose.features.opencv import AKAZE, BRIEF, FREAK, ORB, SIFT
from lightning_pose.features.pixels import Pixels
from lightning_pose.features.surf import SURF

__all__ = [
    "AKAZE",
    "BRIEF",
    "CNN",
    "FREAK",
    "ORB",
    "SIFT",
    "SURF",
    "FeatureCache",
    "FeatureExtractor",
    "FillReport",
    "LocalExtractor",
    "Pixels",
]
