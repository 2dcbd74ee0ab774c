"""The page over HTTP, on the loopback interface only, read only: some files, the run's facts, and the events.

In front of `live.stream`. Every connection has a thread, a time limit and no influence on the others.
"""

from __future__ import annotations

import socket
import sys
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from socketserver import TCPServer
from threading import Lock, Thread
from typing import Any, ClassVar

from live.stream import RETRY_MS, Broadcast

LOOPBACK = "127.0.0.1"
NAMES = ("127.0.0.1", "localhost")
"""What a request may call this host: a page elsewhere whose name was bound to 127.0.0.1 gives its own name."""
METHODS = ("GET", "HEAD")
MOST_CONNECTIONS = 32
PATIENCE_S = 5.0
"""So long a client may leave a request, or what it is sent, unfinished."""
SEND_BUFFER = 64 * 1024
"""Bytes on their way to a page that does not read; then its thread waits, and it misses events."""
PAGE = Path(__file__).parent / "page"
KINDS = {
    ".html": "text/html; charset=utf-8",
    ".css": "text/css; charset=utf-8",
    ".js": "text/javascript; charset=utf-8",
    ".svg": "image/svg+xml",
}
HEADERS = {
    "Content-Security-Policy": (
        "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self'; connect-src 'self'; "
        "base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
    ),
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cache-Control": "no-store",
}


def page_files() -> dict[str, tuple[str, bytes]]:
    """Path, media type and content of everything that does not change."""
    files = {
        f"/{file.name}": (KINDS[file.suffix], file.read_bytes())
        for file in sorted(PAGE.iterdir())
        if file.suffix in KINDS
    }
    files["/"] = files.pop("/index.html")
    return files


class _Handler(BaseHTTPRequestHandler):
    server: LiveServer
    timeout: ClassVar[float] = PATIENCE_S

    def parse_request(self) -> bool:
        """Refuse what is no question of this page, before anything is looked up."""
        if not super().parse_request():
            return False
        if self.command not in METHODS:
            self._answer(HTTPStatus.METHOD_NOT_ALLOWED, allow=True)
        elif not _ours(self.headers.get_all("Host") or []):
            self._answer(HTTPStatus.MISDIRECTED_REQUEST)
        else:
            return True
        return False

    def do_GET(self) -> None:
        """A file, the facts, or the stream."""
        path = self.path.partition("?")[0]
        if path == "/events":
            self._stream()
        elif path in self.server.files:
            kind, content = self.server.files[path]
            self._answer(HTTPStatus.OK, kind, content)
        else:
            self._answer(HTTPStatus.NOT_FOUND)

    do_HEAD = do_GET

    def _stream(self) -> None:
        news = self.server.news
        if self.command == "HEAD":
            self._head(HTTPStatus.OK, {"Content-Type": "text/event-stream"})
            return
        if not news.enter():
            self._answer(HTTPStatus.SERVICE_UNAVAILABLE)
            return
        try:
            self.connection.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, SEND_BUFFER)
            self._head(HTTPStatus.OK, {"Content-Type": "text/event-stream"})
            self.wfile.write(b"retry: %d\n\n" % RETRY_MS)
            seen = 0
            while (fresh := news.after(seen)) is not None:
                seen, text = fresh
                self.wfile.write(text)
        finally:
            news.leave()

    def _answer(
        self,
        status: HTTPStatus,
        kind: str = "text/plain; charset=utf-8",
        content: bytes | None = None,
        *,
        allow: bool = False,
    ) -> None:
        body = f"{status.value} {status.phrase}\n".encode() if content is None else content
        fields = {"Content-Type": kind, "Content-Length": str(len(body))}
        if allow:
            fields["Allow"] = ", ".join(METHODS)
        self._head(status, fields)
        if self.command != "HEAD":
            self.wfile.write(body)

    def _head(self, status: HTTPStatus, fields: dict[str, str]) -> None:
        self.send_response(status)
        for name, value in (fields | HEADERS | {"Connection": "close"}).items():
            self.send_header(name, value)
        self.end_headers()

    def send_error(self, code: int, *_: Any, **__: Any) -> None:
        """What the base class refuses itself looks like everything else."""
        self.request_version = (
            "HTTP/1.0"  # to a question without a version the answer would have no head
        )
        self._answer(HTTPStatus(code))

    def version_string(self) -> str:
        """Which software of which version answers is nobody's business."""
        return "octarm"

    def log_message(self, format: str, *args: Any) -> None:
        """Nothing: what a browser asks for is no event of the run."""


def _ours(hosts: list[str]) -> bool:
    if len(hosts) != 1:
        return False
    name, _, port = hosts[0].partition(":")
    return name.lower() in NAMES and (not port or port.isdigit())


class LiveServer(ThreadingHTTPServer):
    """Serves the page from its making until `close`; `facts` is the JSON of /run.json.

    Raises OSError if the port cannot be had (0: any).
    """

    daemon_threads = True
    block_on_close = False
    request_queue_size = 64

    def __init__(self, port: int, facts: bytes, news: Broadcast) -> None:
        self.files = page_files() | {"/run.json": ("application/json", facts)}
        self.news = news
        self._open = 0
        self._lock = Lock()
        self._thread: Thread | None = None
        super().__init__((LOOPBACK, port), _Handler)

    @property
    def url(self) -> str:
        """Where the page is."""
        return f"http://{LOOPBACK}:{self.server_address[1]}/"

    def server_bind(self) -> None:
        """Without the base class's question to the name service, which may not answer."""
        TCPServer.server_bind(self)
        self.server_name, self.server_port = LOOPBACK, int(self.server_address[1])

    def start(self) -> None:
        """Answer from now on, on threads that inherit the caller's scheduling."""
        forever = {"poll_interval": None}
        self._thread = Thread(target=self.serve_forever, kwargs=forever, daemon=True)
        self._thread.start()

    def process_request(self, request: Any, client_address: Any) -> None:
        """Hang up on who comes when there are too many already."""
        with self._lock:
            full = self._open >= MOST_CONNECTIONS
            self._open += not full
        if full:
            self.shutdown_request(request)
        else:
            super().process_request(request, client_address)

    def process_request_thread(self, request: Any, client_address: Any) -> None:
        """The life of a connection's thread."""
        try:
            super().process_request_thread(request, client_address)
        finally:
            with self._lock:
                self._open -= 1

    def handle_error(self, request: Any, client_address: Any) -> None:
        """A client that goes away, or is too slow, is no fault; anything else belongs into the log."""
        if not isinstance(sys.exception(), OSError):
            super().handle_error(request, client_address)

    def close(self) -> None:
        """Answer no more; threads that still talk to somebody end with them, or with the process."""
        if self._thread is not None:
            self.socket.shutdown(socket.SHUT_RDWR)  # the thread waits for nothing else
            self.shutdown()
            self._thread = None
        self.server_close()
