"""A room that needs no download: `textures` and `posters` paint it, `room` builds and lights it,
`trajectory` walks through it, `render` draws it, `dataset` writes it in 7-Scenes layout."""

from lightning_pose.scenes.synthetic.dataset import RENDERER_VERSION, render_room

__all__ = ["RENDERER_VERSION", "render_room"]
