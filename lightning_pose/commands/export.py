"""The command `export`: writes a trained system as a folder that runs without torch."""

from __future__ import annotations

from pathlib import Path

from lightning_pose.commands.parser import VerbParser

__all__ = ["main"]

DESCRIPTION = """Write a trained system as a folder that runs with numpy, OpenCV and onnxruntime.

FOLDER gets model.onnx (features of a CNN, network, and pose in the world in one graph), map.safetensors (a landmark
map), localizer.json (what it is), and localizer.py, which locates images. A system without a map has no
map.safetensors, and a map alone needs no onnxruntime.

Before the folder appears, its answers are compared with those of the checkpoint on test frames of the run, or on
--images: same status, and within 1 mm and 0.05 degrees. Otherwise nothing is written."""

EPILOG = """examples:
  python -m lightning_pose export mlruns/checkpoints/RUN_ID/best.ckpt --out kitchen
  python -m lightning_pose export best.ckpt --out kitchen --root DIR        the scene's folder has moved
  python kitchen/localizer.py photo.jpg                                     asks it, with no torch installed"""


def main(argv: list[str]) -> int:
    """Run the command with the arguments after its name; return the exit code."""
    args = _build_parser().parse_args(argv)
    from lightning_pose.checkpoint import read_checkpoint
    from lightning_pose.export.folder import check_target, export_system  # torch, which takes seconds to import
    from lightning_pose.export.frames import find_run_frames, list_image_files
    from lightning_pose.localization.load_source import find_checkpoint
    from lightning_pose.localization.trained_system import TrainedSystem

    check_target(args.out, args.overwrite)
    allow = args.allow or []
    file = find_checkpoint(args.model, args.tracking_uri)
    system, checkpoint = TrainedSystem.from_checkpoint(file, allow), read_checkpoint(file)
    if args.images:
        frames = list_image_files(args.images)
    else:
        frames = find_run_frames(system, checkpoint["lightning_pose"]["data"], allow, args.root, every=args.int8)
    exported = export_system(system, checkpoint, frames, args.out, args.overwrite, args.int8)
    for name, size in exported.n_bytes.items():
        print(f"{exported.folder / name}  {size:,} bytes")
    print("\n".join(exported.describe()))
    return 0


def _build_parser() -> VerbParser:
    parser = VerbParser("export", description=DESCRIPTION, epilog=EPILOG)
    parser.add_argument("model", metavar="MODEL", help="a checkpoint that fit wrote, a run id, or a model's address")
    parser.add_argument("--out", metavar="FOLDER", type=Path, required=True, help="folder to write")
    parser.add_argument("--overwrite", action="store_true", help="replace a folder that export wrote")
    parser.add_argument(
        "--images", metavar="PATH", type=Path, nargs="+", help="images to compare answers on, or folders"
    )
    parser.add_argument("--root", metavar="DIR", help="where the run's scene is now (default: where it was)")
    parser.add_argument(
        "--int8",
        action="store_true",
        help="weights in 8 bits, if that costs at most 5 %% of the accuracy on frames of the run",
    )
    parser.add_argument("--tracking_uri", help="MLflow's store, for runs and models")
    parser.add_argument("--allow", action="append", help="class path, or package, of your own that it may name")
    return parser
