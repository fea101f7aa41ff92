"""Folders of posed images as a `Scene` of frames and splits: `formats` reads them, `synthetic` renders one."""
