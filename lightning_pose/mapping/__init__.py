"""Geometry from the training images: whether their poses fit them, and the landmark map."""
