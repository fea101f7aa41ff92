"""The text of `localizer.py`, the one file that asks an exported folder without this package."""

from __future__ import annotations

from functools import cache

from lightning_pose.export.one_file import join_modules

__all__ = ["write_runner"]

ROOTS = ("lightning_pose.localization.localizer.Localizer", "lightning_pose.export.runner.command.main")

REPLACED = {
    "scipy.spatial.transform.Rotation": "lightning_pose.export.runner.rotation.Rotation",
    "lightning_pose.localization.inputs.ImageInput": "lightning_pose.export.runner.inputs.ImageInput",
    "lightning_pose.localization.inputs.list_images": "lightning_pose.export.runner.inputs.list_images",
    "lightning_pose.localization.inputs.load_image": "lightning_pose.export.runner.inputs.load_image",
    "lightning_pose.mapping.threads.multiply": "lightning_pose.export.runner.products.multiply",
    "lightning_pose.localization.load_source.load_system": "lightning_pose.export.runner.system.load_system",
}
"""What stands in for modules that need scipy, Pillow or torch."""

HEAD = """Locates images with the model in this folder: needs numpy, OpenCV and, for a network, onnxruntime.

    python localizer.py IMAGE...                      one JSON line an image

    from localizer import Localizer
    localizer = Localizer.load(FOLDER)
    pose = localizer.localize("image.jpg")            pose.position_m, pose.quat_wxyz, pose.status, ...

`python -m lightning_pose export` has written this file of modules of lightning_pose, word for word. It is longer than a
module should be, because it must stand alone. Its parts, by their lines:

CONTENTS
"""

TAIL = """if __name__ == "__main__":
    sys.exit(main(Path(__file__).resolve().parent))"""


@cache
def write_runner() -> str:
    """The file's text; the same for every model."""
    return join_modules(ROOTS, REPLACED, HEAD, TAIL)
