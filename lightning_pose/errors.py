"""Exceptions for mistakes of the user; the command line prints each as one line and exits with code 2."""

__all__ = ["CacheError", "CheckpointError", "ConfigError", "DataError", "ImageError", "PoseError"]


class PoseError(Exception):
    """A mistake in what the user gave; the message names the offending value and the remedy."""


class DataError(PoseError):
    """A dataset on disk that is missing, malformed or empty."""


class ImageError(DataError):
    """An image file that is missing, unreadable, or of a kind that cannot be used."""


class CacheError(PoseError):
    """A feature cache that cannot be read or written."""


class ConfigError(PoseError):
    """A setting that has the wrong type or value, or that does not fit the others."""


class CheckpointError(PoseError):
    """A checkpoint that is missing, unreadable, or belongs to another architecture."""
