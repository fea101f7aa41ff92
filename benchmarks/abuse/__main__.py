"""The command line of the abuse."""

from __future__ import annotations

import argparse
import logging
import sys
import tempfile
import time
import warnings
from collections.abc import Callable, Iterator
from importlib import import_module
from pathlib import Path

from benchmarks.abuse.table import Row
from benchmarks.abuse.workplace import Workplace, make_workplace

KINDS = {
    "signals": ("benchmarks.abuse.signals", "send_signals", "SIGINT, SIGTERM, SIGHUP and a closed terminal"),
    "disks": (
        "benchmarks.abuse.faults",
        "break_disks",
        "full and broken disks, a read-only home, a store that is locked or gone",
    ),
    "fits": ("benchmarks.abuse.kills", "kill_fits", "kill -9 of fit, which then goes on"),
    "commands": ("benchmarks.abuse.kills", "kill_commands", "kill -9 of extract, export and reconstruct"),
    "writes": ("benchmarks.abuse.writes", "kill_writes", "kill -9 at single writes of fit, of a map, and of export"),
    "threads": ("benchmarks.abuse.threads", "compare_threads", "the same fit with one and with two threads"),
    "records": ("benchmarks.abuse.damage", "damage_records", "bytes flipped in a cache record and in checkpoints"),
    "exported": ("benchmarks.abuse.damage", "damage_exported", "bytes flipped in the files of an exported folder"),
}


CASES = {
    "fits": "SurfLSTM CNNRNN NodePose LandmarkMap",
    "threads": "SurfLSTM CNNRNN NodePose LandmarkMap refined",
    "commands": "extract export reconstruct",
    "writes": "fit export",
    "disks": "extract fit export home lock server",
}
"""Names for `--only`, by kind."""

DESCRIPTION = """Kills commands, breaks their disks and stores, and damages their files.

It prints a row of a Markdown table for each case. The exit code is 1 if anything misbehaved.
It needs Linux, and a compiler (gcc) for disks and writes."""

EXAMPLE = """examples:
  python -m benchmarks.abuse fits --only NodePose --times 5      minutes
  python -m benchmarks.abuse disks --work /dev/shm/abuse         a folder in memory is much quicker than a disk"""


def main() -> int:
    """Run the command; the exit code."""
    args = _parse()
    warnings.simplefilter("ignore")
    logging.disable(logging.WARNING)
    misbehaved = 0
    with tempfile.TemporaryDirectory() as temporary:
        if {"disks", "writes"} & set(args.what):
            import_module("benchmarks.abuse.faults").preload_faults(Path(temporary))
        print("| done | times | misbehaved | otherwise |\n|---|---:|---|---|", flush=True)
        for what in args.what:
            module, name, _ = KINDS[what]
            abuse: Callable[[Workplace, int | None], Iterator[Row]] = getattr(import_module(module), name)
            started = time.monotonic()
            for row in abuse(make_workplace((args.work or Path(temporary)) / what, args.only), args.times):
                print(row, flush=True)
                misbehaved += sum(row.bad.values())
            print(f"{what}: {time.monotonic() - started:.0f} s", file=sys.stderr, flush=True)
    return 1 if misbehaved else 0


def _parse() -> argparse.Namespace:
    lines = "\n".join(f"  {name:12}{says}" for name, (_, _, says) in KINDS.items())
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.abuse",
        description=f"{DESCRIPTION}\n\nkinds:\n{lines}",
        epilog=EXAMPLE,
        formatter_class=argparse.RawTextHelpFormatter,
    )
    parser.add_argument("what", metavar="KIND", choices=KINDS, nargs="+", help="one or more kinds")
    parser.add_argument(
        "--work", metavar="DIR", type=Path, help="work in DIR/KIND, which is emptied (default: a temporary folder)"
    )
    parser.add_argument(
        "--times",
        metavar="N",
        type=_parse_times,
        help="how often each is done (default: 30, 6 for signals, 1000 bytes)",
    )
    cases = "\n".join(f"{kind}: {names}" for kind, names in CASES.items())
    parser.add_argument(
        "--only", metavar="CASE", nargs="+", default=(), help=f"only these cases (default: all)\n{cases}"
    )
    args = parser.parse_args()
    known = " ".join(CASES.values()).split()
    if unknown := [name for name in args.only if name not in known]:
        parser.error(f"--only: no case is called {' or '.join(unknown)}; --help lists them")
    return args


def _parse_times(text: str) -> int:
    if not text.isdecimal() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"{text!r} is no number of times; give 1 or more")
    return int(text)


if __name__ == "__main__":
    sys.exit(main())
