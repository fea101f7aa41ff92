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
    torch.testing.assert_close(mirrored[:, 64:], plain[:, 64:] * torch.tensor([-1.0, 1, 1, 1]), atol=0, rtol=0)
    place = plain[:, 64:66] * torch.tensor([-1.0, 1])
    distance, partner = (place[:, None] - turned[:, 64:66]).norm(dim=-1).min(1)
    same = (distance < 0.02) & ((plain[:, 66] - turned[partner, 66]).abs() < 0.1)
    assert same.float().mean() > 0.6
    similarity = (mirrored[same, :64] * turned[partner[same], :64]).sum(1)
    assert similarity.median() > 0.98
    assert (similarity > 0.9).float().mean() > 0.9
