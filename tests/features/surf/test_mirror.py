"""SURF features of a mirrored image: those of the image, mirrored, wherever both find the same point."""

from __future__ import annotations

import torch

from lightning_pose.features.surf import SURF
from tests.features.surf.test_extractor import texture


def test_mirrored_features_are_those_of_the_mirrored_image() -> None:
    extractor = SURF(100, upright=True, with_geometry=True)
    image = texture().numpy()[0]
    records = extractor.extract([image, image[:, ::-1].copy()])
    plain, turned = (torch.from_numpy(extractor.features(record)) for record in records)
    mirrored = extractor.mirror(plain)
    similarity, partner = (mirrored[:, :64] @ turned[:, :64].T).max(1)
    same = similarity > 0.95
    assert same.float().mean() > 0.8
    torch.testing.assert_close(mirrored[same, 64:66], turned[partner[same], 64:66], atol=0.03, rtol=0)
    unlike = (plain[:, :64] @ turned[:, :64].T).max(1).values
    assert (unlike > 0.95).float().mean() < 0.2
