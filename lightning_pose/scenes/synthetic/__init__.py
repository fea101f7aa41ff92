"""A synthetic dataset that needs no download: images of a furnished room.

`textures` and `posters` make the textures, `room` the surfaces and their light, `trajectory` the camera's paths,
`render` the images, `dataset` the files.
"""

from lightning_pose.scenes.synthetic.dataset import RENDERER_VERSION, render_room

__all__ = ["RENDERER_VERSION", "render_room"]
