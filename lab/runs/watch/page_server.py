"""The server of the live page: http.server with events and pictures, on the loopback address unless stated otherwise.

Decision and measurements: docs/decisions/live-server.md.
"""

from __future__ import annotations

import hmac
import ipaddress
import json
import secrets
import socket
import threading
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any
from urllib.parse import parse_qs, urlsplit

from lab.errors import InputError

_INTERVAL_S = 0.25  # between two states sent to a browser
_MOST_READERS = 8  # browsers at the same time
_STALLED_S = 10.0  # after which a browser that reads nothing is given up
_PROTECTED = (
    ("Cache-Control", "no-store"),
    ("Cross-Origin-Resource-Policy", "same-origin"),
    ("X-Content-Type-Options", "nosniff"),
    ("Referrer-Policy", "no-referrer"),
)


@dataclass(slots=True)
class PageServer:
    """Serves one page, its states and its pictures, each browser in its own thread.

    A browser gets the state of the moment as soon as it has taken the one before, so nothing queues up for a slow one.

    page: the HTML. state: of the moment, as JSON; called with whether it is the last. picture: of a camera, as JPEG,
    and what is drawn on it; None: not yet.
    """

    address: str  # PORT, or HOST:PORT
    page: str
    state: Callable[[bool], str]
    picture: Callable[[str], tuple[bytes, dict[str, Any]] | None]
    token: str = ""  # empty: only this computer can connect
    _server: ThreadingHTTPServer = field(init=False)
    _stop: threading.Event = field(default_factory=threading.Event)
    _readers: threading.Semaphore = field(default_factory=lambda: threading.Semaphore(_MOST_READERS))

    def __post_init__(self) -> None:
        """Raises InputError: the address is wrong or in use."""
        host, _, port = (self.address if ":" in self.address else f"127.0.0.1:{self.address}").rpartition(":")
        host = host.strip("[]")
        if not (host and port.isascii() and port.isdigit() and int(port) < 65536):
            raise InputError(f"--page: expected PORT or HOST:PORT such as 8080, got {self.address!r}")
        try:
            found = socket.getaddrinfo(host, int(port), type=socket.SOCK_STREAM)[0]
            kind = type("Server", (ThreadingHTTPServer,), {"address_family": found[0], "daemon_threads": True})
            self._server = kind(found[4][:2], _handler_of(self))
        except OSError as error:
            raise InputError(f"--page: {self.address}: {error.strerror}; choose another port") from None
        if not ipaddress.ip_address(found[4][0]).is_loopback:
            self.token = secrets.token_urlsafe(16)

    def __enter__(self) -> PageServer:
        threading.Thread(target=self._server.serve_forever, name="page", daemon=True).start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._server.shutdown()
        self._server.server_close()

    @property
    def url(self) -> str:
        """The page's address, with the token where one is needed."""
        host, port = self._server.server_address[:2]
        shown = f"[{host!s}]" if ":" in str(host) else str(host)
        shown = socket.gethostname() if shown in ("0.0.0.0", "[::]") else shown
        return f"http://{shown}:{port}/" + (f"?token={self.token}" if self.token else "")

    def allows(self, host: str, token: str) -> bool:
        """Whether a request may be answered. host: its header, which another site's page cannot choose."""
        if self.token:
            return hmac.compare_digest(token, self.token)
        name = urlsplit(f"//{host}").hostname or ""
        return name == "localhost" or (_is_address(name) and ipaddress.ip_address(name).is_loopback)


def _is_address(text: str) -> bool:
    with suppress(ValueError):
        ipaddress.ip_address(text)
        return True
    return False


def _handler_of(page: PageServer) -> type[BaseHTTPRequestHandler]:
    class Handler(BaseHTTPRequestHandler):
        timeout = _STALLED_S

        def log_message(self, *_: object) -> None:
            """Nothing: the terminal shows the recording."""

        def do_GET(self) -> None:
            where = urlsplit(self.path)
            given = parse_qs(where.query)
            with suppress(OSError, ValueError):  # the browser has gone
                if not page.allows(self.headers.get("Host", ""), given.get("token", [""])[0]):
                    self._answer(403, "text/plain", b"the address of the page contains a token that this one lacks\n")
                elif where.path == "/":
                    self._answer(200, "text/html; charset=utf-8", page.page.encode())
                elif where.path == "/state":
                    self._states()
                elif where.path == "/picture":
                    self._picture(given.get("camera", [""])[0])
                else:
                    self._answer(404, "text/plain", b"not here\n")

        def _answer(self, status: int, kind: str, content: bytes, more: tuple[tuple[str, str], ...] = ()) -> None:
            self._head(status, kind, (*more, ("Content-Length", str(len(content)))))
            self.wfile.write(content)

        def _head(self, status: int, kind: str, more: tuple[tuple[str, str], ...]) -> None:
            self.send_response(status)
            for name, value in (("Content-Type", kind), *_PROTECTED, *more):
                self.send_header(name, value)
            self.end_headers()

        def _picture(self, camera: str) -> None:
            found = page.picture(camera)
            if found is None:
                self._answer(204, "text/plain", b"")
            else:
                self._answer(200, "image/jpeg", found[0], (("X-Marks", json.dumps(found[1])),))

        def _states(self) -> None:
            if not page._readers.acquire(blocking=False):
                return self._answer(503, "text/plain", b"too many browsers\n")
            try:
                self._head(200, "text/event-stream", ())
                while True:
                    over = page._stop.is_set()
                    self.wfile.write(f"data: {page.state(over)}\n\n".encode())
                    self.wfile.flush()
                    if over:
                        return None
                    page._stop.wait(_INTERVAL_S)
            finally:
                page._readers.release()

    return Handler
