"""A Zenoh peer written by hand, over TCP or TLS: it sends what it likes, whatever the other end has asked for.

A session of the library sends a message only where somebody has subscribed to it, which access control does
not let an intruder know. Only the handshake and Put are here (Zenoh's protocol, version 9); test_bare_peer.py
shows that another session understands them.
"""

from __future__ import annotations

import secrets
import socket
import ssl
from pathlib import Path
from types import TracebackType
from typing import Self

_INIT, _OPEN, _CLOSE, _FRAME, _PUSH, _PUT = 0x01, 0x02, 0x03, 0x05, 0x1D, 0x01
_ACK, _RELIABLE, _NAMED, _SECONDS = 1 << 5, 1 << 5, 1 << 5, 1 << 6
_SIZES = 1 << 6
_VERSION = 9
_CLIENT = 0b10
LEASE_S = 60


def client_context(directory: Path | None, name: str = "") -> ssl.SSLContext:
    """TLS that believes anybody, with the certificate of `name` in a directory, or none."""
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    context.check_hostname = False
    context.verify_mode = ssl.CERT_NONE
    if directory is not None:
        context.load_cert_chain(directory / f"{name}.pem", directory / f"{name}.key")
    return context


class PeerRefusedError(ConnectionError):
    """The other end has closed the link in Zenoh's own words."""


class BarePeer:
    """One link, opened when made. OSError (ssl.SSLError is one) if the other end refuses."""

    def __init__(
        self, port: int, context: ssl.SSLContext | None, identity: str | None = None
    ) -> None:
        """`identity` is its Zenoh number, hexadecimal; None: a random one."""
        plain = socket.create_connection(("127.0.0.1", port), timeout=10)
        try:
            self._socket = plain if context is None else context.wrap_socket(plain)
            plain = self._socket
            self._open(secrets.token_hex(16) if identity is None else identity)
        except BaseException:
            plain.close()
            raise

    def _open(self, identity: str) -> None:
        zid = bytes.fromhex(identity)[::-1]
        self._send(bytes([_INIT, _VERSION, (len(zid) - 1) << 4 | _CLIENT]) + zid)
        cookie = self._cookie(self._receive())
        self._sn = 0
        about = _number(LEASE_S) + _number(self._sn) + _number(len(cookie))
        self._send(bytes([_OPEN | _SECONDS]) + about + cookie)
        _expect(self._receive(), _OPEN)

    def put(self, key: str, payload: bytes, times: int = 1) -> None:
        """Publish a message on a key, several times in one write."""
        name = key.encode()
        push = bytes([_PUSH | _NAMED]) + _number(0) + _number(len(name)) + name
        put = push + bytes([_PUT]) + _number(len(payload)) + payload
        frames = b""
        for _ in range(times):
            frame = bytes([_FRAME | _RELIABLE]) + _number(self._sn) + put
            frames += len(frame).to_bytes(2, "little") + frame
            self._sn = (self._sn + 1) % (1 << 28)
        self._socket.sendall(frames)

    def close(self) -> None:
        """Hang up."""
        self._socket.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    def _send(self, message: bytes) -> None:
        self._socket.sendall(len(message).to_bytes(2, "little") + message)

    def _receive(self) -> bytes:
        return self._exactly(int.from_bytes(self._exactly(2), "little"))

    def _exactly(self, count: int) -> bytes:
        data = b""
        while len(data) < count:
            piece = self._socket.recv(count - len(data))
            if not piece:
                raise ConnectionError("the other end hung up")
            data += piece
        return data

    def _cookie(self, answer: bytes) -> bytes:
        _expect(answer, _INIT)
        at = 3 + (answer[2] >> 4) + 1 + (3 if answer[0] & _SIZES else 0)
        length, at = _read(answer, at)
        return answer[at : at + length]


def _expect(answer: bytes, kind: int) -> None:
    if answer[0] & 0x1F == _CLOSE:
        raise PeerRefusedError(f"closed for reason {answer[1]}")
    assert answer[0] & 0x1F == kind and answer[0] & _ACK, answer


def _number(value: int) -> bytes:
    """Seven bits a byte, the lowest first."""
    out = bytearray()
    while value > 0x7F:
        out.append(value & 0x7F | 0x80)
        value >>= 7
    out.append(value)
    return bytes(out)


def _read(data: bytes, at: int) -> tuple[int, int]:
    """Such a number in `data`, and where it ends."""
    value = shift = 0
    while True:
        value |= (data[at] & 0x7F) << shift
        shift += 7
        at += 1
        if not data[at - 1] & 0x80:
            return value, at
