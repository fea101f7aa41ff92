"""All benchmarks of speed in one command, each beside a named peer and a goal, as one Markdown table.

    python -m benchmarks [NAMES...] [--root DIR] [--pgt DIR] [--rounds N] [--out FILE.md]

Without names it runs all of them; those that need a real scene are left out, and named, without `--root`. Each runs in
a process of its own. `python -m benchmarks.NAME --help` explains one of them and its options.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from dataclasses import asdict
from importlib import import_module
from pathlib import Path
from typing import NamedTuple

from benchmarks.measurement import Measurement, Options, describe_machine, format_table, restore_measurement

__all__ = ["BENCHMARKS", "main"]


class Benchmark(NamedTuple):
    """A module of this package with a function `measure`.

    Attributes:
        says: what it measures, beside which peer, and the goal.
        needs_root: whether it needs a real scene.
    """

    says: str
    needs_root: bool = False


BENCHMARKS = {
    "startup": Benchmark("commands beside `import torch`: 1.5 s; `fit` beside `import lightning`: 1.15 of it"),
    "extract": Benchmark("two workers beside one: 1.8 times as fast; CNN features beside a bare loop: 1.05 of it"),
    "epoch": Benchmark("an epoch of every architecture beside a bare PyTorch loop: 1.05 of it"),
    "ridge": Benchmark("closed forms beside scikit-learn's Ridge, KernelRidge and Nystroem: 0.7 of it"),
    "surf": Benchmark("SURF beside OpenCV's SIFT: 0.21 of it"),
    "report": Benchmark("`report` of 1,000 runs beside MLflow's search: 3 s"),
    "serve": Benchmark("50 requests at once beside MLflow's model server: no fewer images a second"),
    "query": Benchmark("a query of a landmark map beside OpenCV's SIFT alone: 50 ms", needs_root=True),
    "map_build": Benchmark("a landmark map from image files on: a minute", needs_root=True),
}


def run_benchmark(name: str, options: Options) -> list[Measurement]:
    """The rows of one benchmark, which runs in a process of its own."""
    from benchmarks.made_frames import ask_process

    found = ask_process("benchmarks", name, *_list_words(options))
    return [restore_measurement(each) for each in found["measurements"]]


def _list_words(options: Options) -> list[str]:
    """The options as words of a command line."""
    return [word for name, value in asdict(options).items() if value is not None for word in (f"--{name}", str(value))]


def main(argv: list[str] | None = None) -> int:
    lines = "\n".join(
        f"  {name:10}{each.says}{' (needs --root)' if each.needs_root else ''}" for name, each in BENCHMARKS.items()
    )
    parser = argparse.ArgumentParser(
        "python -m benchmarks", description=f"{__doc__}\n{lines}", formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("names", nargs="*", metavar="NAMES", help="which to run (default: all)")
    parser.add_argument("--root", help="folder of a real scene; SURF and extraction then take its images too")
    parser.add_argument("--pgt", help="folder of its pseudo ground truth")
    parser.add_argument("--rounds", type=int, help="how often everything is measured (default: each benchmark's own)")
    parser.add_argument("--out", type=Path, help="write the table there as well")
    parser.add_argument("--one", action="store_true", help=argparse.SUPPRESS)
    args = parser.parse_args(argv)
    unknown = [name for name in args.names if name not in BENCHMARKS]
    if unknown:
        parser.error(f"there is no benchmark {unknown[0]}; choose of {', '.join(BENCHMARKS)}")
    options = Options(args.root, args.pgt, args.rounds)
    if args.one:
        (name,) = args.names
        found = import_module(f"benchmarks.{name}").measure(options)
        print(json.dumps({"measurements": [asdict(each) for each in found]}))
        return 0
    chosen = args.names or [*BENCHMARKS]
    left_out = [name for name in chosen if BENCHMARKS[name].needs_root and not args.root]
    found, machine = [], describe_machine()
    for name in chosen:
        if name not in left_out:
            started = time.monotonic()
            found += run_benchmark(name, options)
            print(f"{name}: {time.monotonic() - started:.0f} s", file=sys.stderr, flush=True)
    missing = f"\n\nLeft out without --root: {', '.join(left_out)}." if left_out else ""
    text = f"{machine}\n\n{format_table(found)}{missing}\n"
    print(text, end="")
    if args.out:
        args.out.write_text(text)
    return 0


if __name__ == "__main__":
    sys.exit(main())
