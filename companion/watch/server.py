"""The page of `companion watch --web`: a few fixed answers to GET, and a stream of events.

It shows and takes nothing in: only GET, only the paths below, only for a Host that is an address, `localhost`
or the name that it was bound to (so that no other site's name can be made to point here), no scripts, styles
or pictures from elsewhere. Slow and surplus clients are turned away.
"""

from __future__ import annotations

import ipaddress
import queue
import socket
import sys
import threading
from collections.abc import Callable
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib import resources
from socketserver import TCPServer
from typing import Any

MOST_CLIENTS = 32
"""Connections at the same time; a page needs one for as long as it is open."""
TIMEOUT_S = 10.0
"""For a request to arrive, and for a client to take what it is sent."""
BACKLOG = 50
"""Messages that wait for a client at most; it is then cut off, and comes back by itself."""

_HEADERS = {
    "Content-Security-Policy": "default-src 'none'; script-src 'self'; style-src 'self'; connect-src 'self'; "
    "img-src data:; base-uri 'none'; form-action 'none'; frame-ancestors 'none'",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cache-Control": "no-store",
}
_FILES = {
    "/": ("watch/page.html", "text/html; charset=utf-8"),
    "/page.js": ("watch/page.js", "text/javascript; charset=utf-8"),
    "/map.js": ("watch/map.js", "text/javascript; charset=utf-8"),
    "/plots.js": ("watch/plots.js", "text/javascript; charset=utf-8"),
    "/page.css": ("watch/page.css", "text/css; charset=utf-8"),
    "/theme.css": ("theme.css", "text/css; charset=utf-8"),
}
"""Everything that can be asked for, besides `/events`."""

_Client = queue.SimpleQueue[bytes | None]
"""Messages on their way to one page; None: the stream ends."""


class PageServer:
    """Serves the page from threads of its own; `tell` feeds every page that is open."""

    def __init__(self, bind: str, port: int) -> None:
        """Port 0: any. Raises OSError where it cannot listen there."""
        self._lock = threading.Lock()
        self._new: set[_Client] = set()
        self._clients: set[_Client] = set()
        self._server = _Server(bind, port, self)
        self._thread = threading.Thread(
            target=self._server.serve_forever, args=(0.1,), name="page", daemon=True
        )
        self._thread.start()

    @property
    def url(self) -> str:
        """Where it is, as seen from this machine."""
        host, port = self._server.server_address[:2]
        name = {"0.0.0.0": "127.0.0.1", "::": "::1"}.get(str(host), str(host))
        return f"http://[{name}]:{port}/" if ":" in name else f"http://{name}:{port}/"

    def tell(self, message: bytes, past: Callable[[], bytes]) -> None:
        """What is new to every open page, all of the past to those that were opened just now."""
        with self._lock:
            for client in self._clients:
                client.put(message if client.qsize() < BACKLOG else None)
            if self._new:
                everything = past()
                for client in self._new:
                    client.put(everything)
            self._clients |= self._new
            self._new.clear()

    def join(self) -> _Client:
        """A new page."""
        client: _Client = queue.SimpleQueue()
        with self._lock:
            self._new.add(client)
        return client

    def leave(self, client: _Client) -> None:
        """A page that was closed."""
        with self._lock:
            self._new.discard(client)
            self._clients.discard(client)

    def close(self) -> None:
        """End every stream and give the port back."""
        with self._lock:
            for client in self._clients | self._new:
                client.put(None)
        self._server.shutdown()
        self._server.server_close()


class _Server(ThreadingHTTPServer):
    """At most MOST_CLIENTS threads."""

    daemon_threads = True

    def __init__(self, bind: str, port: int, page: PageServer) -> None:
        self.address_family = socket.AF_INET6 if ":" in bind else socket.AF_INET
        self.page = page
        self.name = bind.lower()
        self.files = {
            path: (kind, resources.files("companion").joinpath(name).read_bytes())
            for path, (name, kind) in _FILES.items()
        }
        self._places = threading.BoundedSemaphore(MOST_CLIENTS)
        super().__init__((bind, port), _Handler)

    def server_bind(self) -> None:
        """Without HTTPServer's reverse look-up of the name: without a network it takes seconds."""
        TCPServer.server_bind(self)

    def process_request(self, request: Any, client_address: Any) -> None:
        if self._places.acquire(blocking=False):
            super().process_request(request, client_address)
        else:
            self.shutdown_request(request)

    def process_request_thread(self, request: Any, client_address: Any) -> None:
        try:
            super().process_request_thread(request, client_address)
        finally:
            self._places.release()

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Clients that go away in the middle are no news; anything else is a bug and told."""
        if not isinstance(sys.exception(), OSError):
            super().handle_error(request, client_address)


class _Handler(BaseHTTPRequestHandler):
    """One request. HTTP/1.0: the connection ends with the answer; other methods than GET are 501."""

    server: _Server
    server_version = "companion"
    sys_version = ""
    timeout = TIMEOUT_S

    def do_GET(self) -> None:
        """Answer one of the known paths."""
        if not is_ours(self.headers.get("Host", ""), self.server.name):
            self._refuse(HTTPStatus.MISDIRECTED_REQUEST, "open this page by its address or as localhost")
            return
        path = self.path.partition("?")[0]
        if path == "/events":
            self._events()
        elif path in self.server.files:
            kind, content = self.server.files[path]
            self._begin(HTTPStatus.OK, kind, len(content))
            self.wfile.write(content)
        else:
            self._refuse(HTTPStatus.NOT_FOUND, "no such page")

    def _events(self) -> None:
        """Server-sent events until the page is closed, cut off, or the watch ends."""
        self._begin(HTTPStatus.OK, "text/event-stream", None)
        client = self.server.page.join()
        try:
            while (message := client.get()) is not None:
                self.wfile.write(b"data: " + message + b"\n\n")
        finally:
            self.server.page.leave(client)

    def _refuse(self, status: HTTPStatus, why: str) -> None:
        content = f"{why}\n".encode()
        self._begin(status, "text/plain; charset=utf-8", len(content))
        self.wfile.write(content)

    def _begin(self, status: HTTPStatus, kind: str, length: int | None) -> None:
        self.send_response(status)
        for name, value in _HEADERS.items():
            self.send_header(name, value)
        self.send_header("Content-Type", kind)
        if length is not None:
            self.send_header("Content-Length", str(length))
        self.end_headers()

    def log_message(self, format: str, *args: object) -> None:
        """Requests are not told."""


def is_ours(host: str, bound: str) -> bool:
    """True where a Host header names an address, `localhost` or the name that was bound to."""
    name = host.rpartition(":")[0] if ":" in host and not host.endswith("]") else host
    name = name.lower()
    if name in ("localhost", bound):
        return True
    try:
        ipaddress.ip_address(name.removeprefix("[").removesuffix("]"))
    except ValueError:
        return False
    return True
