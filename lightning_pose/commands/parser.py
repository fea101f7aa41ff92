"""The argument parser of the verbs outside Lightning's command line: a mistake is one line."""

from __future__ import annotations

import argparse
from typing import NoReturn

from lightning_pose.errors import ConfigError

__all__ = ["VerbParser"]


class VerbParser(argparse.ArgumentParser):
    """A parser that raises ConfigError instead of printing its usage and ending the process.

    Args:
        verb: what follows `python -m lightning_pose`.
        usage: the line above the help; argparse makes one if it is not given.
        description: the help's text.
        epilog: below the options.
    """

    def __init__(
        self, verb: str, usage: str | None = None, description: str | None = None, epilog: str | None = None
    ) -> None:
        super().__init__(
            f"python -m lightning_pose {verb}",
            usage,
            description,
            epilog,
            formatter_class=argparse.RawDescriptionHelpFormatter,
            allow_abbrev=False,
        )

    def error(self, message: str) -> NoReturn:
        raise ConfigError(f"{message}; `{self.prog} --help` explains every option")
