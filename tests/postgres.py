"""A PostgreSQL server of the tests' own: made from the system's programs, on a free port, and gone afterwards."""

from __future__ import annotations

import getpass
import os
import pwd
import shutil
import signal
import socket
import subprocess
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from urllib.parse import quote

import pytest

__all__ = ["PASSWORD", "serve"]

PASSWORD = "pass%word:of/ada"
"""What an address must write otherwise."""


@contextmanager
def serve() -> Iterator[str]:
    """Run a server of one user, `ada`.

    Yields:
        The start of its addresses: `postgresql://ada:...@127.0.0.1:PORT/`, to which a database's name is added.
    """
    programs = _programs()
    user = _user()
    # Not pytest's folder, which nobody but its owner may enter.
    folder = Path(tempfile.mkdtemp(prefix="postgres-"))
    try:
        (folder / "password").write_text(PASSWORD)
        if user is not None:
            for path in (folder, folder / "password"):
                os.chown(path, user, -1)
        made = [programs / "initdb", "-D", folder / "data", "-U", "ada", "-A", "scram-sha-256", "--no-sync"]
        made += ["--encoding", "UTF8", "--locale", "C", f"--pwfile={folder / 'password'}"]
        subprocess.run(made, user=user, cwd=folder, check=True, capture_output=True, timeout=120)
        with _running(programs, folder, user) as port:
            yield f"postgresql://ada:{quote(PASSWORD, safe='')}@127.0.0.1:{port}/"
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def _programs() -> Path:
    """The newest server that Debian's packages have installed, or what is on the path."""
    found = sorted(Path("/usr/lib/postgresql").glob("*/bin/initdb"), key=lambda path: float(path.parts[-3]))
    named = shutil.which("initdb")
    if not found and named is None:
        pytest.skip("no PostgreSQL server here; on Debian the package postgresql has it")
    return found[-1].parent if found else Path(str(named)).parent


def _user() -> int | None:
    """Who runs the server, which refuses to be root; None for the user of the tests."""
    if os.geteuid() != 0:
        return None
    for name in ("postgres", "nobody"):
        try:
            return pwd.getpwnam(name).pw_uid
        except KeyError:
            continue
    pytest.skip(f"PostgreSQL does not run as {getpass.getuser()}, and there is no user postgres or nobody")


@contextmanager
def _running(programs: Path, folder: Path, user: int | None) -> Iterator[int]:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    settings = {"listen_addresses": "127.0.0.1", "unix_socket_directories": folder, "fsync": "off"}
    command = [programs / "postgres", "-D", folder / "data", "-p", str(port)]
    command += [word for name, value in settings.items() for word in ("-c", f"{name}={value}")]
    with (folder / "log").open("w") as log:
        server = subprocess.Popen(command, user=user, cwd=folder, stdout=log, stderr=log)
        try:
            ready = [programs / "pg_isready", "-q", "-h", "127.0.0.1", "-p", str(port)]
            deadline = time.monotonic() + 60
            while subprocess.run(ready, check=False).returncode != 0:
                assert server.poll() is None, (folder / "log").read_text()
                assert time.monotonic() < deadline, (folder / "log").read_text()
                time.sleep(0.1)
            yield port
        finally:
            server.send_signal(signal.SIGINT)  # PostgreSQL's fast stop; SIGTERM would wait for open connections
            try:
                server.wait(10)
            except subprocess.TimeoutExpired:
                server.send_signal(signal.SIGQUIT)
                server.wait(10)
