"""Images without poses to a COLMAP scene: frames are chosen, matched and mapped by pycolmap, and made metric.

In order: `source` reads a video or a folder, `frame_choice` chooses frames, `keypoints` and `pairs` and `matches` fill
COLMAP's database, `mapper` runs pycolmap in a process of its own, `pieces` joins what it left apart, `alignment` makes
the scene metric, `diagnosis` says what is wrong. `pipeline` calls them.
"""
