"""The live page over HTTP: what is answered, what is refused, and who cannot hold whom up."""

from __future__ import annotations

import functools
import json
import re
import socket
import threading
import time
import urllib.error
import urllib.request
from collections.abc import Iterator
from contextlib import ExitStack
from html.parser import HTMLParser

import pytest
import waiting

from live.server import HEADERS, MOST_CONNECTIONS, PAGE, LiveServer
from live.server import PATIENCE_S as SILENCE_S
from live.stream import HEARTBEAT_S, MOST_PAGES, Broadcast

FACTS = {"run_id": "r", "nodes": 3}
WAIT_S = 20.0
"""For what should happen at once, on a busy machine."""


class Served:
    """A server at work, with words for its clients."""

    def __init__(self) -> None:
        self.news = Broadcast()
        self.server = LiveServer(0, json.dumps(FACTS).encode(), self.news)
        self.server.start()
        self.port = int(self.server.server_address[1])

    def get(self, path: str = "/", method: str = "GET") -> tuple[int, dict[str, str], bytes]:
        url = f"http://127.0.0.1:{self.port}{path}"
        try:
            with urllib.request.urlopen(
                urllib.request.Request(url, method=method), timeout=WAIT_S
            ) as a:
                return a.status, dict(a.headers), a.read()
        except urllib.error.HTTPError as error:
            with error:
                return error.code, dict(error.headers), error.read()

    def connect(self) -> socket.socket:
        return socket.create_connection(("127.0.0.1", self.port), timeout=WAIT_S)

    def raw(self, request: str) -> bytes:
        """All that is answered to these bytes."""
        with self.connect() as client:
            client.sendall(request.encode())
            client.shutdown(socket.SHUT_WR)
            answer = b""
            while piece := client.recv(65536):
                answer += piece
            return answer

    def stream(self) -> socket.socket:
        """A client whose stream has begun."""
        client = self.connect()
        client.sendall(b"GET /events HTTP/1.1\r\nHost: localhost\r\n\r\n")
        return client


@pytest.fixture
def served() -> Iterator[Served]:
    served = Served()
    yield served
    served.news.end()
    assert served.news.empty(WAIT_S)
    served.server.close()


def read_until(client: socket.socket, text: bytes) -> bytes:
    got = b""
    while text not in got:
        piece = client.recv(65536)
        assert piece, got
        got += piece
    return got


until = functools.partial(waiting.until, seconds=WAIT_S)


# -- files ------------------------------------------------------------------------------------------


def test_the_page_its_parts_and_the_facts_are_served(served: Served) -> None:
    status, headers, body = served.get()
    assert (status, headers["Content-Type"]) == (200, "text/html; charset=utf-8")
    assert body == (PAGE / "index.html").read_bytes()
    kinds = {".js": "text/javascript; charset=utf-8", ".css": "text/css; charset=utf-8"}
    for file in PAGE.iterdir():
        if file.suffix in kinds:
            status, headers, body = served.get(f"/{file.name}?anything")
            assert (status, headers["Content-Type"]) == (200, kinds[file.suffix])
            assert body == file.read_bytes()
    status, headers, body = served.get("/run.json")
    assert (status, headers["Content-Type"], json.loads(body)) == (200, "application/json", FACTS)


def test_every_answer_has_the_strict_headers_and_names_no_version(served: Served) -> None:
    for path, method in (("/", "GET"), ("/live.js", "HEAD"), ("/nothing", "GET"), ("/", "POST")):
        _, headers, _ = served.get(path, method)
        for name, value in HEADERS.items():
            assert headers[name] == value
        assert headers["Server"] == "octarm"
    policy = HEADERS["Content-Security-Policy"]
    assert policy.startswith("default-src 'none';")
    assert "unsafe" not in policy
    assert not re.search(r"https?:|\*|data:|blob:", policy)


def test_a_head_is_the_answer_without_its_body(served: Served) -> None:
    _, headers, _ = served.get("/live.css")
    status, only, body = served.get("/live.css", "HEAD")
    assert (status, body) == (200, b"")
    assert only["Content-Length"] == headers["Content-Length"]
    status, headers, body = served.get("/events", "HEAD")
    assert (status, headers["Content-Type"], body) == (200, "text/event-stream", b"")


class References(HTMLParser):
    """What a page refers to, and what its policy would not let it do."""

    def __init__(self) -> None:
        super().__init__()
        self.files: set[str] = set()
        self.forbidden: list[str] = []
        self._script = False

    def handle_starttag(self, tag: str, attributes: list[tuple[str, str | None]]) -> None:
        for name, value in attributes:
            if name in ("src", "href") and value:
                self.files.add(value)
            if name.startswith("on") or name == "style":
                self.forbidden.append(f"{tag} {name}")
        self._script = tag in ("script", "style")

    def handle_data(self, data: str) -> None:
        if self._script and data.strip():
            self.forbidden.append(data)

    def handle_endtag(self, tag: str) -> None:
        self._script = False


def test_the_page_needs_nothing_but_what_is_served_here(served: Served) -> None:
    _, _, body = served.get()
    page = References()
    page.feed(body.decode())
    assert page.forbidden == []
    assert {"live.css", "live.js", "live.svg"} <= page.files
    for name in page.files:
        assert served.get(f"/{name}")[0] == 200
    for file in PAGE.iterdir():
        text = file.read_text().replace("http://www.w3.org/2000/svg", "")
        assert not re.search(r"https?:|//[a-z]+\.[a-z]", text), file
        assert not re.search(r"\beval\(|innerHTML|document\.write|@import|url\(", text), file
        for name in re.findall(r'from "\./([^"]+)"', text):
            assert served.get(f"/{name}")[0] == 200


# -- refusals ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "path", ["/nothing", "/index.html", "/../live/server.py", "/page/live.js", "/%2e%2e/x"]
)
def test_there_is_nothing_else(served: Served, path: str) -> None:
    status, headers, body = served.get(path)
    assert (status, body) == (404, b"404 Not Found\n")
    assert headers["Content-Type"].startswith("text/plain")


@pytest.mark.parametrize("method", ["POST", "PUT", "DELETE", "OPTIONS", "PATCH", "TRACE", "BREW"])
def test_nothing_can_be_changed(served: Served, method: str) -> None:
    status, headers, _ = served.get("/", method)
    assert (status, headers["Allow"]) == (405, "GET, HEAD")


@pytest.mark.parametrize(
    ("host", "status"),
    [
        ("127.0.0.1", 200),
        ("127.0.0.1:{port}", 200),
        ("localhost", 200),
        ("LOCALHOST:{port}", 200),
        ("localhost:9000", 200),  # a forwarded port
        ("evil.example", 421),
        ("evil.example:{port}", 421),
        ("127.0.0.1.evil.example", 421),
        ("localhost.", 421),
        ("127.0.0.1:80:80", 421),
        ("127.0.0.1@evil.example", 421),
        ("192.168.0.1", 421),
        ("[::1]", 421),
        ("", 421),
    ],
)
def test_a_name_that_is_not_this_hosts_is_refused(served: Served, host: str, status: int) -> None:
    for path in ("/", "/run.json", "/live.js"):
        name = host.format(port=served.port)
        answer = served.raw(f"GET {path} HTTP/1.1\r\nHost: {name}\r\n\r\n")
        assert answer.startswith(f"HTTP/1.0 {status} ".encode())
        assert status == 200 or answer.endswith(b"421 Misdirected Request\n")


def test_no_name_or_two_names_are_refused(served: Served) -> None:
    assert b" 421 " in served.raw("GET / HTTP/1.1\r\n\r\n").splitlines()[0]
    two = "GET / HTTP/1.1\r\nHost: localhost\r\nHost: evil.example\r\n\r\n"
    assert b" 421 " in served.raw(two).splitlines()[0]
    events = "GET /events HTTP/1.1\r\nHost: evil.example\r\n\r\n"
    assert b" 421 " in served.raw(events).splitlines()[0]
    assert not served.news.watched


@pytest.mark.parametrize(
    "request_",
    ["nonsense\r\n\r\n", "GET / HTTP/9.9\r\n\r\n", "GET / x y z\r\n\r\n", f"GET /{'x' * 70000}"],
)
def test_what_is_no_request_is_refused_in_a_word(served: Served, request_: str) -> None:
    answer = served.raw(request_)
    assert re.match(rb"HTTP/1.0 (4|5)\d\d ", answer)
    assert b"Traceback" not in answer
    assert b"Content-Security-Policy" in answer
    assert served.get()[0] == 200


# -- the stream -------------------------------------------------------------------------------------


def test_the_stream_has_retry_ids_names_and_data(served: Served) -> None:
    served.news.put("state", b'{"state":"running"}')
    with served.stream() as client:
        got = read_until(client, b'"running"}\n\n')
        head, _, events = got.partition(b"\r\n\r\n")
        assert head.startswith(b"HTTP/1.0 200 ")
        assert b"Content-Type: text/event-stream\r\n" in head
        assert b"Content-Length" not in head
        assert events == b'retry: 2000\n\nid: 1\nevent: state\ndata: {"state":"running"}\n\n'
        began = time.monotonic()
        served.news.put("frame", b'{"tick":1}')
        assert read_until(client, b"\n\n") == b'id: 2\nevent: frame\ndata: {"tick":1}\n\n'
        assert read_until(client, b"\n\n") == b":\n\n"  # a heartbeat when nothing happens
        assert HEARTBEAT_S <= time.monotonic() - began < HEARTBEAT_S + 5.0


def test_who_comes_late_gets_the_newest_of_each_kind_in_their_order(served: Served) -> None:
    served.news.put("frame", b"1")
    served.news.put("state", b"2")
    served.news.put("frame", b"3")
    with served.stream() as client:
        got = read_until(client, b"data: 3\n\n")
    assert got.endswith(b"id: 2\nevent: state\ndata: 2\n\nid: 3\nevent: frame\ndata: 3\n\n")
    assert b"data: 1" not in got


def test_the_last_event_reaches_everybody_before_the_stream_ends(served: Served) -> None:
    with ExitStack() as stack:
        clients = [stack.enter_context(served.stream()) for _ in range(3)]
        for client in clients:
            read_until(client, b"retry: 2000\n\n")
        served.news.put("state", b"over")
        served.news.end()
        for client in clients:
            read_until(client, b"data: over\n\n")
            assert client.recv(1) == b""
    assert served.news.empty(WAIT_S)


def test_so_many_pages_and_no_more(served: Served) -> None:
    with ExitStack() as stack:
        clients = [stack.enter_context(served.stream()) for _ in range(MOST_PAGES)]
        for client in clients:
            read_until(client, b"retry: 2000\n\n")
        assert served.get("/events")[0] == 503
        assert served.get("/")[0] == 200
        clients[0].close()  # noticed at the next heartbeat
        until(served.news.enter)
        served.news.leave()


def test_a_page_that_comes_or_goes_is_told() -> None:
    told: list[bool] = []
    news = Broadcast(lambda: told.append(news.watched))
    assert news.enter()
    news.leave()
    assert told == [True, False]


def test_a_page_that_does_not_read_misses_events_and_holds_nobody_up(served: Served) -> None:
    with ExitStack() as stack:
        slow = socket.socket()
        slow.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        slow.settimeout(WAIT_S)
        slow.connect(("127.0.0.1", served.port))
        stack.enter_context(slow)
        slow.sendall(b"GET /events HTTP/1.1\r\nHost: localhost\r\n\r\n")
        quick = stack.enter_context(served.stream())
        until(lambda: served.news._pages == 2)
        read_until(quick, b"retry: 2000\n\n")
        content = b"x" * 20_000
        for number in range(60):
            served.news.put("frame", b"%d %s" % (number, content))
            read_until(quick, b"\n\n")  # every one of them
        got = read_until(slow, b"data: 59 ")
        numbers = [int(text) for text in re.findall(rb"data: (\d+) ", got)]
        assert numbers == sorted(set(numbers))
        assert len(numbers) < 30


def test_a_page_that_never_reads_is_given_up(
    served: Served, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("live.server._Handler.timeout", 0.3)
    with served.stream():
        until(lambda: served.news.watched)
        limit = time.monotonic() + WAIT_S
        while served.news.watched:
            assert time.monotonic() < limit
            served.news.put("frame", b"x" * 1_000_000)
            time.sleep(0.02)


def test_clients_that_say_nothing_hold_up_neither_others_nor_the_end() -> None:
    before = set(threading.enumerate())
    served = Served()
    with ExitStack() as stack:
        for _ in range(5):
            silent = stack.enter_context(served.connect())
            silent.sendall(b"GET / HT")
        stack.enter_context(served.stream())
        until(lambda: served.news.watched)
        assert served.get()[0] == 200
        own = set(threading.enumerate()) - before
        assert len(own) >= 7  # one for each of these, and one that waits for more
        began = time.monotonic()
        served.news.end()
        served.news.empty(1.0)
        served.server.close()
        assert (
            time.monotonic() - began < SILENCE_S / 2
        )  # nobody has waited for those that say nothing
    with pytest.raises(OSError, match="refused"):
        served.connect().close()
    until(lambda: not any(thread.is_alive() for thread in own))


def test_too_many_connections_are_hung_up_on(served: Served) -> None:
    with ExitStack() as stack:
        for _ in range(MOST_CONNECTIONS):
            stack.enter_context(served.connect())
        until(lambda: served.server._open == MOST_CONNECTIONS)
        with served.connect() as one_more:
            assert one_more.recv(1) == b""
    until(lambda: served.server._open == 0)
    assert served.get()[0] == 200


def test_it_listens_on_loopback_only(served: Served) -> None:
    assert served.server.server_address[0] == "127.0.0.1"
    assert served.server.url == f"http://127.0.0.1:{served.port}/"


def test_a_port_that_is_taken_is_an_error() -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken, pytest.raises(OSError, match="in use"):
        LiveServer(taken.getsockname()[1], b"{}", Broadcast())
