"""How the verbs outside Lightning's command line read their arguments: alike, and with one line for a mistake."""

from __future__ import annotations

import argparse
from typing import Any, NoReturn

from lightning_pose.errors import ConfigError

__all__ = ["VerbParser"]


class VerbParser(argparse.ArgumentParser):
    """A parser that raises ConfigError instead of printing its usage and leaving.

    Args:
        verb: what is said after `python -m lightning_pose`.
        **kwargs: what argparse takes.
    """

    def __init__(self, verb: str, **kwargs: Any) -> None:
        layout = {"formatter_class": argparse.RawDescriptionHelpFormatter, "allow_abbrev": False}
        super().__init__(prog=f"python -m lightning_pose {verb}", **layout | kwargs)

    def error(self, message: str) -> NoReturn:
        raise ConfigError(f"{message}; `{self.prog} --help` explains every option")
