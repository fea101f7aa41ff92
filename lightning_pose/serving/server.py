"""Runs the application with uvicorn: address, signals, and connections that send nothing."""

from __future__ import annotations

import asyncio
import signal
import socket
from types import FrameType

import uvicorn
from fastapi import FastAPI
from uvicorn.protocols.http.h11_impl import H11Protocol

from lightning_pose.errors import ConfigError

__all__ = ["bind_socket", "make_server", "run_server"]

HEADERS_S = 10.0
"""How long a client may take to send the head of a request."""

STOP_S = 5
"""How long requests may take to end after a signal, beyond the time that a request may take."""


class TimedProtocol(H11Protocol):
    """Uvicorn's protocol, which ends connections where no request arrives: uvicorn itself waits for ever."""

    _head_timer: asyncio.TimerHandle | None = None

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        super().connection_made(transport)
        self._watch_head()

    def data_received(self, data: bytes) -> None:
        super().data_received(data)
        self._watch_head()

    def connection_lost(self, exc: Exception | None) -> None:
        super().connection_lost(exc)
        self._stop_timer()

    def _watch_head(self) -> None:
        """Run the timer while no request is being answered."""
        waits = self.cycle is None or self.cycle.response_complete
        if not waits:
            self._stop_timer()
        elif self._head_timer is None:
            self._head_timer = self.loop.call_later(HEADERS_S, self._end_if_waiting)

    def _stop_timer(self) -> None:
        if self._head_timer is not None:
            self._head_timer.cancel()
            self._head_timer = None

    def _end_if_waiting(self) -> None:
        self._head_timer = None
        if (self.cycle is None or self.cycle.response_complete) and not self.transport.is_closing():
            self.transport.close()


def bind_socket(host: str, port: int) -> socket.socket:
    """A listening socket; port 0 is any free one.

    Raises:
        ConfigError: the address cannot be used.
    """
    if not 0 <= port < 1 << 16:
        raise ConfigError(f"--port is {port}; give 0 to 65535")
    try:
        family, kind, protocol, _, address = socket.getaddrinfo(
            host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE
        )[0]
        listener = socket.socket(family, kind, protocol)
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listener.bind(address)
        listener.listen()  # here, where a port that is taken is one line
    except OSError as error:
        reason = error.strerror or str(error)
        raise ConfigError(f"--host {host} --port {port} cannot be used ({reason}); give another") from error
    return listener


def make_server(app: FastAPI, timeout_s: float, access_log: bool = False) -> uvicorn.Server:
    """A server that has not started.

    Args:
        app: of `create_app`.
        timeout_s: how long a request may take, which a stop waits for.
        access_log: print a line for each request.
    """
    config = uvicorn.Config(
        app,
        http=TimedProtocol,
        ws="none",
        lifespan="on",
        log_level="info" if access_log else "warning",
        access_log=access_log,
        server_header=False,
        proxy_headers=False,  # nobody may say that a request comes from elsewhere
        timeout_graceful_shutdown=int(timeout_s) + STOP_S,
    )
    return uvicorn.Server(config)


def run_server(server: uvicorn.Server, listener: socket.socket) -> None:
    """Answer requests until SIGINT, SIGTERM or SIGHUP; those that have begun are answered first.

    Raises:
        KeyboardInterrupt: after SIGINT.
        SystemExit: with code 143, after SIGTERM, or 129, after SIGHUP.
    """
    hung_up: list[int] = []

    def end(number: int, frame: FrameType | None) -> None:
        raise SystemExit(128 + number)

    def hang_up(number: int, frame: FrameType | None) -> None:  # uvicorn leaves this signal alone
        hung_up.append(number)
        server.should_exit = True

    # Uvicorn raises the signal again once it has stopped. Shells let background jobs ignore SIGINT, which it overrides.
    handlers = {signal.SIGTERM: end, signal.SIGINT: signal.default_int_handler}
    if hasattr(signal, "SIGHUP") and signal.getsignal(signal.SIGHUP) != signal.SIG_IGN:  # as under `nohup`
        handlers[signal.SIGHUP] = hang_up
    before = {number: signal.signal(number, handler) for number, handler in handlers.items()}
    try:
        server.run(sockets=[listener])
    finally:
        for number, handler in before.items():
            signal.signal(number, signal.SIG_DFL if handler is None else handler)
        listener.close()
    if hung_up:
        raise SystemExit(128 + hung_up[0])
