"""The command line: verbs and their mains; each verb imports only what it needs."""

from __future__ import annotations

import difflib
import errno
import gc
import os
import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from importlib import import_module

from lightning_pose.concurrency.signals import STOPPING, interrupt_on
from lightning_pose.errors import PoseError

__all__ = ["main"]

PROGRAM = "python -m lightning_pose"

VERBS = {
    "fit": ("lightning_pose.cli", "train a localizer, test it, and print it beside its baselines"),
    "validate": ("lightning_pose.cli", "measure a checkpoint on the validation frames"),
    "test": ("lightning_pose.cli", "measure a checkpoint on the test frames, beside its baselines"),
    "predict": ("lightning_pose.cli", "write a checkpoint's poses of the test frames as TUM files"),
    "localize": (
        "lightning_pose.commands.localize",
        "locate images, a folder, a video or a camera with a trained system",
    ),
    "extract": ("lightning_pose.commands.extract", "fill the feature cache: parallel, resumable"),
    "sweep": ("lightning_pose.commands.sweep", "search a config's settings, on validation frames: parallel, resumable"),
    "report": (
        "lightning_pose.commands.report",
        "tables of finished runs: systems by scenes, beside baselines and published rows",
    ),
    "check": ("lightning_pose.commands.check", "say what a dataset holds, and what is wrong with it"),
    "export": ("lightning_pose.commands.export", "write a folder that locates images with no torch installed"),
    "export-map": ("lightning_pose.commands.export_map", "write a landmark map as a COLMAP model and as PLY"),
    "reconstruct": (
        "lightning_pose.commands.reconstruct",
        "find the poses of a video's frames, or of images (pycolmap)",
    ),
    "serve": ("lightning_pose.commands.serve", "answer images with poses over HTTP, with a page to try it"),
    "synth": ("lightning_pose.commands.synth", "render a synthetic room as a dataset"),
}

FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EROFS)
"""Numbers of the operating system's errors for a disk that is full, or that takes no file."""

USAGE = """usage: python -m lightning_pose VERB [options]

Cheap camera localization: a folder of posed images in, a trained and measured localizer out.

{verbs}

Start with    python -m lightning_pose fit --config configs/quickstart.yaml
Your data     python -m lightning_pose fit --config configs/landmark_map.yaml --data.root DIR
Every option  python -m lightning_pose VERB --help"""


def usage() -> str:
    """The page that `--help` prints."""
    return USAGE.format(verbs="\n".join(f"  {verb:12}{says}" for verb, (_, says) in VERBS.items()))


def main(argv: list[str] | None = None) -> int:
    """Run one verb.

    Returns:
        The exit code: 0 done, 2 the user's mistake, 130 interrupted by Ctrl-C, 143 by SIGTERM, 129 by SIGHUP. An
        internal error keeps its traceback.
    """
    argv = sys.argv[1:] if argv is None else argv
    if not argv or argv[0] in ("-h", "--help"):
        print(usage())
        return 0 if argv else 2
    verb = argv[0]
    if verb not in VERBS:
        near = difflib.get_close_matches(verb, VERBS, n=1)
        hint = f"did you mean {near[0]}?" if near else f"choose one of {', '.join(VERBS)}"
        print(f"error: there is no verb {verb!r}; {hint}", file=sys.stderr)
        return 2
    with interrupt_on(STOPPING) as received:
        try:
            return _run_verb(verb, argv)
        except KeyboardInterrupt as stop:
            _say_last("; ".join(["interrupted", *map(str, stop.args)]))
            return 128 + (received[0] if received else signal.SIGINT)


def _run_verb(verb: str, argv: list[str]) -> int:
    """The exit code of a verb; mistakes of the user and refusals are printed."""
    try:
        name = VERBS[verb][0]
        with _leave_garbage(name not in sys.modules):
            module = import_module(name)
        return module.main(argv if verb in LIGHTNING_VERBS else argv[1:])
    except PoseError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    except OSError as error:
        if error.errno not in FULL:
            raise
        print(
            f"error: {error.filename or 'a file'} cannot be written ({error.strerror}); free some space, or choose "
            "another folder",
            file=sys.stderr,
        )
        return 2
    except Exception as error:
        refusal = _find_refusal(error)
        if refusal is None:
            raise
        print(f"error: {refusal}; `{PROGRAM} {verb} --help` explains every setting", file=sys.stderr)
        return 2


@contextmanager
def _leave_garbage(new: bool) -> Iterator[None]:
    """Import a new module without garbage collection, which is a sixth of the time that importing Lightning takes.

    What is imported stays, so that looking for garbage among it is in vain, then and in each later collection.
    """
    if not new or not gc.isenabled():
        yield
        return
    gc.disable()
    try:
        yield
        gc.freeze()
    finally:
        gc.enable()


def _say_last(line: str) -> None:
    """Print the last line of a command; a terminal that was closed takes none, nor what is still to be written."""
    try:
        print(line, file=sys.stderr, flush=True)
        sys.stdout.flush()
    except OSError:
        nowhere = os.open(os.devnull, os.O_WRONLY)
        for stream in (sys.stdout, sys.stderr):
            os.dup2(nowhere, stream.fileno())


def _find_refusal(error: Exception) -> str | None:
    """Lightning's words where it refuses a setting; it is imported already if it does."""
    if "lightning" not in sys.modules:
        return None
    from lightning_pose.runs.lightning_messages import describe_refusal

    return describe_refusal(error)


LIGHTNING_VERBS = tuple(verb for verb, (module, _) in VERBS.items() if module == "lightning_pose.cli")
"""Verbs that LightningCLI parses, as its subcommands."""

if __name__ == "__main__":
    sys.exit(main())
