"""The command `export-map`: writes a checkpoint's landmark map as a COLMAP model and as PLY files."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from rich.progress import track

from lightning_pose.commands.parser import VerbParser
from lightning_pose.errors import ConfigError, PoseError
from lightning_pose.mapping.model_files import Reconstruction, correct_camera, write_colmap_model, write_ply_files
from lightning_pose.scenes.images import read_rgb

if TYPE_CHECKING:
    from lightning_pose.data import SceneDataModule
    from lightning_pose.models import PoseModule
    from lightning_pose.models.parts.map_network import MapNetwork

__all__ = ["main"]

DESCRIPTION = """Write the landmark map in a checkpoint for other programs.

DIR gets cameras.txt, images.txt and points3D.txt, which COLMAP and pycolmap read, and points.ply and cameras.ply, which
MeshLab and Blender show. Poses are those of the map: after bundle adjustment they differ from the given ones.
Observations lie where the points appear in the images, because the map does not keep where keypoints were.

Names, cameras and colours come from the images that the map was built of. Where they are not to be found, images are
named by number, all have the map's camera, and points are gray."""

EPILOG = """examples:
  python -m lightning_pose export-map mlruns/checkpoints/RUN_ID/best.ckpt kitchen
  python -m lightning_pose export-map best.ckpt kitchen --root DIR      the scene's folder has moved"""

GRAY = 160


def main(argv: list[str]) -> int:
    """Run the command with the arguments after its name; return the exit code."""
    args = _build_parser().parse_args(argv)
    from lightning_pose.localization.trained_system import TrainedSystem  # torch, which takes seconds to import

    model = TrainedSystem.from_checkpoint(args.checkpoint, args.allow or ()).model
    network = model.map_network
    if network is None:
        raise ConfigError(
            f"{args.checkpoint} holds a {type(model).__name__} without a map; give one of LandmarkMap, or of a system "
            "that was trained with --model.refine true"
        )
    found = _reconstruct(model, network, _find_images(args.checkpoint, args.root, args.allow or (), model, network))
    for file in (*write_colmap_model(args.dir, found), *write_ply_files(args.dir, found)):
        print(file)
    print(f"{len(found.points)} points seen by {len(found.names)} images in {len(found.seen_point)} observations")
    return 0


def _build_parser() -> VerbParser:
    parser = VerbParser("export-map", description=DESCRIPTION, epilog=EPILOG)
    parser.add_argument("checkpoint", metavar="CKPT", type=Path, help="a checkpoint that fit wrote")
    parser.add_argument("dir", metavar="DIR", type=Path, help="folder to write")
    parser.add_argument("--root", metavar="DIR", help="where the scene is now (default: where it was)")
    parser.add_argument("--allow", action="append", help="class path, or package, of your own that it may name")
    return parser


def _find_images(
    checkpoint: Path, root: str | None, allow: list[str] | tuple[()], model: PoseModule, network: MapNetwork
) -> tuple[SceneDataModule, list[int]] | None:
    """The data that the map was built of, and the frames of the map; None with a line that says why they are not found.

    Raises:
        ConfigError: the user has named a folder that does not have them.
    """
    from lightning_pose.checkpoint import build_object, check_specs, read_checkpoint

    spec = check_specs(read_checkpoint(checkpoint)["lightning_pose"], allow)["data"]
    assert spec is not None, "a localizer has been made of it"
    extractor = build_object(spec["init_args"]["extractor"], allow, "lightning_pose.features")
    settings = spec["init_args"] | {"extractor": extractor} | ({"root": root} if root else {})
    try:
        datamodule: SceneDataModule = build_object({**spec, "init_args": settings}, allow, "lightning_pose.data")
        frames = sorted(int(i) for split in model.training_splits for i in datamodule.scene.splits[split])
        if len(frames) != len(network.position):
            raise ConfigError(f"it has {len(frames)} training frames, and the map {len(network.position)}")
        given = np.array([datamodule.scene.frames[i].position_m for i in frames])
        moved = np.linalg.norm(given - _to_world(model, network.point_map.given_position), axis=1)
        if moved.max() > 1e-4 * np.ptp(given, axis=0).max():
            raise ConfigError("its training frames have other poses than those of the map")
        read_rgb(datamodule.scene.frames[frames[0]].image)
    except PoseError as error:
        if root:
            raise ConfigError(f"{root} is not the scene that the map was built of: {error}") from error
        print(f"the images are not to be found ({error}); --root names the scene's folder")
        return None
    return datamodule, frames


def _reconstruct(
    model: PoseModule, network: MapNetwork, images: tuple[SceneDataModule, list[int]] | None
) -> Reconstruction:
    """The map in the world, with the names and cameras of its images and the colours of its points."""
    from lightning_pose.models.parts.frame_cameras import list_cameras

    point_map = network.point_map
    count = len(point_map.position)
    if images is None:
        names, cameras = [f"image-{i:06d}" for i in range(count)], [network.view] * count
    else:
        datamodule, numbers = images
        root = datamodule.scene.root
        paths = [datamodule.scene.frames[i].image for i in numbers]
        names = [str(path.relative_to(root)) if path.is_relative_to(root) else path.name for path in paths]
        cameras = list_cameras(datamodule, numbers, network.view)
    correction = point_map.camera_correction
    found = Reconstruction(
        names=names,
        cameras=[correct_camera(camera, correction) for camera in cameras],
        rotation=point_map.rotation,
        position=_to_world(model, point_map.position),
        points=_to_world(model, point_map.points),
        colors=np.full((len(point_map), 3), GRAY, np.uint8),
        seen_frame=point_map.seen_frame,
        seen_point=point_map.seen_point.astype(np.int64),
    )
    return found if images is None else _color_points(found, paths)


def _to_world(model: PoseModule, position: np.ndarray) -> np.ndarray:
    """(N, 3) positions of the map in the world."""
    import torch

    return model.world_frame.to_world(torch.from_numpy(position)).numpy()


def _color_points(model: Reconstruction, images: list[Path]) -> Reconstruction:
    """The same with the mean colour that each point has in its images."""
    pixels = model.project_observations().round().astype(np.int64)
    total, count = np.zeros((len(model.points), 3)), np.zeros(len(model.points))
    for i, path in enumerate(track(images, "reading colours", transient=True)):
        image, mine = read_rgb(path), model.seen_frame == i
        x, y = pixels[mine].T
        inside = (x >= 0) & (y >= 0) & (x < image.shape[1]) & (y < image.shape[0])
        point = model.seen_point[mine][inside]  # a point is seen once in an image
        total[point] += image[y[inside], x[inside]]
        count[point] += 1
    mean = np.where(count[:, None] > 0, total / np.maximum(count, 1)[:, None], GRAY)
    return replace(model, colors=mean.round().astype(np.uint8))
