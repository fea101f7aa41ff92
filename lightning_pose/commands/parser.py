"""The argument parser of the verbs outside Lightning's command line: a mistake is one line."""

from __future__ import annotations

import argparse
from typing import Any, NoReturn

from lightning_pose.errors import ConfigError

__all__ = ["VerbParser"]


class VerbParser(argparse.ArgumentParser):
    """A parser that raises ConfigError instead of printing its usage and ending the process.

    Args:
        verb: what follows `python -m lightning_pose`.
        **kwargs: of `argparse.ArgumentParser`.
    """

    def __init__(self, verb: str, **kwargs: Any) -> None:
        layout = {"formatter_class": argparse.RawDescriptionHelpFormatter, "allow_abbrev": False}
        super().__init__(prog=f"python -m lightning_pose {verb}", **layout | kwargs)

    def error(self, message: str) -> NoReturn:
        raise ConfigError(f"{message}; `{self.prog} --help` explains every option")
