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
    "disks": ("benchmarks.abuse.faults", "break_disks", "full and broken disks, a read-only home, a locked store"),
    "fits": ("benchmarks.abuse.kills", "kill_fits", "kill -9 of fit, which then goes on"),
    "commands": ("benchmarks.abuse.kills", "kill_commands", "kill -9 of extract, export and reconstruct"),
    "threads": ("benchmarks.abuse.threads", "compare_threads", "the same fit with one and with two threads"),
    "records": ("benchmarks.abuse.damage", "damage_records", "bytes flipped in a cache record and in checkpoints"),
    "exported": ("benchmarks.abuse.damage", "damage_exported", "bytes flipped in the files of an exported folder"),
}


def main() -> int:
    lines = "\n".join(f"  {name:12}{says}" for name, (_, _, says) in KINDS.items())
    parser = argparse.ArgumentParser(description=f"{__doc__}\n\n{lines}", formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("what", choices=KINDS, nargs="+")
    parser.add_argument("--work", type=Path, help="a folder to work in, which is emptied (default: a temporary one)")
    parser.add_argument("--times", type=int, help="how often each is done")
    args = parser.parse_args()
    warnings.simplefilter("ignore")
    logging.disable(logging.WARNING)
    misbehaved = 0
    with tempfile.TemporaryDirectory() as temporary:
        print("| done | times | misbehaved | otherwise |\n|---|---:|---|---|", flush=True)
        for what in args.what:
            module, name, _ = KINDS[what]
            abuse: Callable[[Workplace, int | None], Iterator[Row]] = getattr(import_module(module), name)
            started = time.monotonic()
            for row in abuse(make_workplace((args.work or Path(temporary)) / what), args.times):
                print(row, flush=True)
                misbehaved += sum(row.bad.values())
            print(f"{what}: {time.monotonic() - started:.0f} s", file=sys.stderr, flush=True)
    return 1 if misbehaved else 0


if __name__ == "__main__":
    sys.exit(main())
