"""A folder on disk as a `Scene`: frames, poses and splits. `formats` reads, `synthetic` renders."""
