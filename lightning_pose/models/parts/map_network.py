"""MapNetwork: a point map as a network, from an image's keypoints to its pose."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields

import numpy as np
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor, nn

from lightning_pose.geometry.absolute_pose import CameraPose
from lightning_pose.geometry.camera import Camera
from lightning_pose.mapping.calibration import Calibration
from lightning_pose.mapping.frames import MapFrames
from lightning_pose.mapping.map_localizer import MapAnswer, MapLocalizer
from lightning_pose.mapping.point_map import PointMap
from lightning_pose.mapping.threads import map_in_threads

__all__ = ["MapNetwork", "keypoints_to_frames"]

GEOMETRY = 4
"""Columns after the descriptor: x and y in -1 to 1, log2 of size by 16 pixels, response (`LocalExtractor`)."""

MAP_SHAPES = {
    "points": ((0, 3), torch.float64),
    "descriptors": ((0, 0), torch.int8),
    "log_size": ((0,), torch.float32),
    "direction": ((0, 3), torch.float32),
    "seen_point": ((0,), torch.int32),
    "seen_count": ((0,), torch.int32),
    "rotation": ((0, 3, 3), torch.float64),
    "position": ((0, 3), torch.float64),
    "given_rotation": ((0, 3, 3), torch.float64),
    "given_position": ((0, 3), torch.float64),
    "camera": ((5,), torch.float64),
}
"""Shape and type of each array of an empty `PointMap`; the descriptor's width is added."""

STORED = {
    "points": torch.float32,
    "log_size": torch.float16,
    "direction": torch.float16,
    "seen_point": torch.uint16,
    "rotation": torch.float32,
    "position": torch.float32,
    "given_rotation": torch.float32,
    "given_position": torch.float32,
}
"""Types in which checkpoints hold arrays, if that loses nothing: half the bytes. Real numbers are rounded to them."""

CAMERA_NUMBERS = 15

RESIZED = ("camera_numbers", *MAP_SHAPES)
"""Buffers whose length is that of the checkpoint: some lenses have more coefficients."""


def keypoints_to_frames(
    features: Tensor, cameras: Sequence[Camera], rotation: np.ndarray, position: np.ndarray
) -> MapFrames:
    """Frames for a map from what a local extractor with `with_geometry` returns.

    Args:
        features: (F, N, D + 4), rows of zeros past the real keypoints.
        cameras: F, each for its image as it is; sizes of keypoints and thresholds are in the pixels of that image.
        rotation: (F, 3, 3), camera-to-world.
        position: (F, 3).
    """
    array = features.cpu().numpy()
    descriptors = np.ascontiguousarray(array[..., :-GEOMETRY], dtype=np.float32)
    real: np.ndarray = (descriptors != 0).any(axis=2)
    x, y, log_size = np.moveaxis(array[..., -GEOMETRY:-1].astype(np.float64), -1, 0)
    points = np.zeros((*x.shape, 2))
    for camera in dict.fromkeys(cameras):
        rows = [row for row, other in enumerate(cameras) if other == camera]
        pixels = np.stack([(x[rows] + 1) * camera.width / 2, (y[rows] + 1) * camera.height / 2], axis=-1)
        points[rows] = np.where(real[rows][..., None], camera.normalize(pixels), 0.0)
    return MapFrames(
        points=points,
        size_px=np.where(real, 16 * 2**log_size, 0).astype(np.float32),
        descriptors=descriptors,
        count=real.sum(axis=1),
        focal_px=np.array([camera.focal_px for camera in cameras]),
        half_view=np.array([camera.half_view for camera in cameras]).reshape(-1, 2),
        rotation=rotation,
        position=position,
    )


class MapNetwork(nn.Module):
    """Locates images in a point map, which it carries as buffers with its camera and calibration.

    Args:
        n_columns: D, of a descriptor.
    """

    calibration: Tensor
    camera_numbers: Tensor
    position: Tensor

    def __init__(self, n_columns: int) -> None:
        super().__init__()
        for name, (shape, kind) in MAP_SHAPES.items():
            self.register_buffer(name, torch.zeros((0, n_columns) if name == "descriptors" else shape, dtype=kind))
        self.register_buffer("camera_numbers", torch.zeros(CAMERA_NUMBERS, dtype=torch.float64))
        self.register_buffer("calibration", torch.full((2,), torch.nan, dtype=torch.float64))
        self._localizer: MapLocalizer | None = None
        self.register_state_dict_post_hook(_store_small)
        self.register_load_state_dict_post_hook(lambda module, _: module.forget_localizer())

    def forget_localizer(self) -> None:
        """Prepare the map again at the next query; its buffers have changed."""
        self._localizer = None

    def set_map(self, point_map: PointMap, camera: Camera, calibration: Calibration) -> None:
        """Take a map, the camera of queries that come without one, and the factors of its radii."""
        device = self.calibration.device
        for field in fields(point_map):
            kind, values = MAP_SHAPES[field.name][1], torch.from_numpy(getattr(point_map, field.name))
            rounded = values.to(STORED.get(field.name, kind)) if values.is_floating_point() else values
            getattr(self, field.name).data = rounded.to(device, kind)
        lens = -len(camera.distortion) if camera.lens else int(camera.fisheye)
        numbers = [camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy, lens]
        numbers += [*camera.distortion, *[0.0] * (8 - len(camera.distortion))]
        self.camera_numbers = torch.tensor(numbers, dtype=torch.float64, device=device)
        factors = [calibration.position_factor, calibration.orientation_factor]
        self.calibration = torch.tensor(factors, dtype=torch.float64, device=device)
        self.forget_localizer()

    @property
    def point_map(self) -> PointMap:
        """The map; empty before `fit`."""
        return PointMap(**{name: getattr(self, name).detach().cpu().numpy() for name in MAP_SHAPES})

    @property
    def view(self) -> Camera:
        """The camera of queries that come without one."""
        width, height, fx, fy, cx, cy, lens, *distortion = self.camera_numbers.tolist()
        count = {0: 8, 1: 4}.get(lens, -int(lens))  # coefficients; below 0 is the number of a lens that OpenCV lacks
        coefficients = tuple(distortion[:count]) if any(distortion) else ()
        return Camera(int(width), int(height), fx, fy, cx, cy, coefficients, lens != 0)

    def locate(
        self, features: Tensor, cameras: Sequence[Camera] | None = None, prior: CameraPose | None = None
    ) -> list[MapAnswer]:
        """Answers for (B, N, D + 4) features.

        Args:
            features: of B images.
            cameras: B, each for its image as it is; `view` for all if None.
            prior: where all may have been taken, in the given poses' unit and origin.

        Raises:
            RuntimeError: there is no map yet.
        """
        if not len(self.position):
            raise RuntimeError("the map is empty; fit it first")
        if self._localizer is None:
            self._localizer = MapLocalizer(self.point_map)
        nowhere = np.zeros((len(features), 3))
        cameras = [self.view] * len(features) if cameras is None else cameras
        frames = keypoints_to_frames(features, cameras, np.zeros((len(features), 3, 3)), nowhere)
        localizer = self._localizer
        return map_in_threads(lambda i: localizer.locate(frames.query(i), prior), range(len(frames)))

    def find_radii(self, answers: list[MapAnswer]) -> tuple[np.ndarray, np.ndarray]:
        """(N,) radii, in the scene's unit and in degrees, that hold 90 % of the errors of accepted answers.

        nan where too few training frames were accepted to calibrate; inf where the map refuses.
        """
        position_factor, orientation_factor = self.calibration.tolist()
        position = np.array([answer.position_sd for answer in answers]) * position_factor
        orientation = np.array([answer.orientation_sd_deg for answer in answers]) * orientation_factor
        refused = ~np.array([answer.accepted for answer in answers], bool)
        return np.where(refused, np.inf, position), np.where(refused, np.inf, orientation)

    def forward(self, features: Tensor, cameras: Sequence[Camera] | None = None) -> Tensor:
        """(B, N, D + 4) -> (B, 7), position and quaternion; the identity where there is no map yet.

        `cameras` as for `locate`.
        """
        if not len(self.position):
            pose = [[0.0, 0, 0, 1, 0, 0, 0]] * len(features)
        else:
            pose = [
                [*answer.pose.position, *Rotation.from_matrix(answer.pose.rotation).as_quat(scalar_first=True)]
                for answer in self.locate(features, cameras)
            ]
        return torch.tensor(np.array(pose).reshape(-1, 7), dtype=features.dtype, device=features.device)


def _store_small(module: nn.Module, state_dict: dict[str, Tensor], prefix: str, *_: object) -> None:
    """Give a state dict the types of `STORED`, where they hold all values; loading turns them back."""
    for name, kind in STORED.items():
        values = state_dict[prefix + name]
        small = values.to(kind)
        if torch.equal(small.to(values.dtype), values):
            state_dict[prefix + name] = small
