"""Render a small synthetic room, train LinearPoseNet on it, and locate three of its test images.

    python examples/locate_images.py

It writes the room to `room/`, and runs and checkpoints to `mlruns/`, in the current folder.
"""

from pathlib import Path

from lightning_pose import Localizer
from lightning_pose.__main__ import main
from lightning_pose.scenes.formats import load_scene
from lightning_pose.scenes.synthetic import render_room

CONFIG = Path(__file__).resolve().parents[1] / "configs" / "linear_posenet.yaml"


def locate_images() -> None:
    """Train on the room, then print true and predicted positions of three test images in metres."""
    room = render_room(Path("room"), frames=40, size=(160, 120))
    if main(["fit", "--config", str(CONFIG), "--data.root", str(room)]) != 0:
        raise SystemExit("fit has failed")
    checkpoints = Path("mlruns/checkpoints").glob("*/best.ckpt")
    newest = max(checkpoints, key=lambda path: path.stat().st_mtime)
    localizer = Localizer.load(newest)
    scene = load_scene(room)
    frames = [scene.frames[i] for i in scene.splits["test"][:3]]
    poses = localizer.localize([frame.image for frame in frames])
    for frame, pose in zip(frames, poses, strict=True):
        print(f"{frame.image.name}: true {frame.position_m.round(2)}, predicted {pose.position_m.round(2)}")


if __name__ == "__main__":
    locate_images()
