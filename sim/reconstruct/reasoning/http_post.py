# SPDX-License-Identifier: MIT
"""One HTTP POST: bounded in time and size, without redirects, cancellable.

http.client is used directly: it reads no proxy settings, follows no redirects and keeps no cookies, so data goes only
to the host of the address.
"""

from __future__ import annotations

import contextlib
import http.client
import queue
import re
import socket
import ssl
import threading
import time
import zlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from urllib.parse import SplitResult, urlsplit

from ...errors import Cancelled, InputError
from ...events import IsCancelled

MAX_ANSWER_BYTES = 2 * 2**20
"""Limit of a body, compressed and uncompressed; answers have a few hundred bytes."""

_CHUNK = 2**16
_POLL_S = 0.05


@dataclass(frozen=True)
class Address:
    """Target of a request: scheme ``http`` or ``https``, host, port, and the path with its query."""

    scheme: str
    host: str
    port: int
    target: str

    def __str__(self) -> str:
        """Without the query, which may contain secrets."""
        host = f"[{self.host}]" if ":" in self.host else self.host
        return f"{self.scheme}://{host}:{self.port}{self.target.partition('?')[0]}"

    @property
    def is_this_machine(self) -> bool:
        """Whether the host is this machine."""
        return self.host in ("localhost", "::1") or re.fullmatch(r"127(\.\d{1,3}){3}", self.host) is not None


@dataclass(frozen=True)
class Reply:
    """A response: ``status``, headers by lower-case name, and the uncompressed body."""

    status: int
    headers: Mapping[str, str] = field(repr=False)
    body: bytes = field(repr=False)


@dataclass(frozen=True)
class Failure:
    """The reason for a failed request, and whether a retry may help."""

    reason: str
    again: bool


def parse_address(url: str) -> Address:
    """Return the address of ``url``. Raises InputError, which does not repeat the URL, as it may contain secrets."""
    # Errors of urlsplit repeat the URL, so ours must not be chained to them.
    parts = _split(url)
    if parts is None:
        raise InputError("url: is not a URL; give one like https://host/v1")
    host, port = parts.hostname, parts.port
    if parts.scheme not in ("http", "https"):
        raise InputError(f"url: scheme is {parts.scheme[:20]!r}; only http and https are used, as in https://host/v1")
    if parts.username is not None or parts.password is not None:
        raise InputError("url: holds a user name or password; take it out and put the key in the environment variable")
    printable = url.isascii() and url.isprintable() and " " not in url
    if not host or not printable or len(url) > 2000:
        raise InputError("url: has no host or odd characters; give an address like https://host/v1")
    return Address(parts.scheme, host, port or {"http": 80, "https": 443}[parts.scheme], _target(parts))


def _split(url: str) -> SplitResult | None:
    try:
        parts = urlsplit(url)
        return parts if parts.port is None or parts.port > 0 else None
    except ValueError:
        return None


def _target(parts: SplitResult) -> str:
    return (parts.path or "/") + (f"?{parts.query}" if parts.query else "")


def post(
    address: Address, body: bytes, headers: Mapping[str, str], timeout_s: float, cancelled: IsCancelled
) -> Reply | Failure:
    """Send ``body`` to ``address`` and wait for the complete answer, at most ``timeout_s``.

    A second thread waits for the network, so that a server that trickles bytes cannot exceed the time-out, and
    ``cancelled`` is polled meanwhile. Raises Cancelled only; all network errors are a Failure.
    """
    exchange = _Exchange(address, body, headers, timeout_s)
    deadline = time.monotonic() + timeout_s
    worker = threading.Thread(target=exchange.run, name="physgen-chat", daemon=True)
    worker.start()
    try:
        while True:
            if cancelled():
                raise Cancelled("the query about the photo was cancelled")
            left = deadline - time.monotonic()
            if left <= 0:
                return Failure(f"gave no complete answer within {timeout_s:g} s", again=False)
            try:
                return exchange.outcome.get(timeout=min(_POLL_S, left))
            except queue.Empty:
                continue
    finally:
        exchange.hang_up()


class _Exchange:
    """One connection, used by one thread; another thread may close it."""

    def __init__(self, address: Address, body: bytes, headers: Mapping[str, str], timeout_s: float) -> None:
        self._address, self._body, self._headers = address, body, headers
        self._connection = _connection(address, timeout_s)
        self._given_up = threading.Event()
        self.outcome: queue.Queue[Reply | Failure] = queue.Queue()

    def run(self) -> None:
        try:
            self._connection.connect()
            if not self._given_up.is_set():
                self.outcome.put(self._talk())
        except ssl.SSLCertVerificationError as error:
            reason = f"has a certificate that cannot be verified ({error.verify_message}); SSL_CERT_FILE names others"
            self.outcome.put(Failure(reason, again=False))
        except TimeoutError:
            self.outcome.put(Failure("did not answer in time", again=False))
        except socket.gaierror:
            self.outcome.put(Failure("has a host name that cannot be found", again=True))
        except (http.client.LineTooLong, http.client.BadStatusLine, http.client.UnknownProtocol) as error:
            # The messages of these repeat server data.
            lost = isinstance(error, http.client.RemoteDisconnected)
            self.outcome.put(Failure("hung up without an answer" if lost else "does not speak HTTP", again=lost))
        except (OSError, http.client.HTTPException, zlib.error, ValueError) as error:
            detail = error.strerror if isinstance(error, OSError) and error.strerror else type(error).__name__
            self.outcome.put(Failure(f"broke the connection off or could not be reached ({detail})", again=True))
        finally:
            self._connection.close()

    def hang_up(self) -> None:
        """Wake the thread if it still waits for the network."""
        self._given_up.set()
        wire = self._connection.sock
        if wire is not None:
            try:
                # On the plain socket: on a TLS socket it would pull the state from under the waiting thread.
                socket.socket.shutdown(wire, socket.SHUT_RDWR)
            except OSError:
                return

    def _talk(self) -> Reply | Failure:
        with contextlib.suppress(BrokenPipeError, ConnectionResetError):
            # A server that rejects early closes while we send; its answer may still be readable.
            self._connection.request("POST", self._address.target, self._body, dict(self._headers))
        response = self._connection.getresponse()
        headers = {name.lower(): value for name, value in response.getheaders()}
        unpack = _unpacker(headers.get("content-encoding", "identity"))
        if unpack is None:
            return Failure("uses an unsupported Content-Encoding", again=False)
        packed, body = 0, bytearray()
        while chunk := response.read1(_CHUNK):
            packed += len(chunk)
            body += unpack(chunk)
            if max(packed, len(body)) > MAX_ANSWER_BYTES:
                return Failure(f"sends more than {MAX_ANSWER_BYTES >> 20} MiB, too much for an answer", again=False)
        if response.length:
            return Failure("broke off in the middle of its answer", again=True)
        return Reply(response.status, headers, bytes(body))


def _connection(address: Address, timeout_s: float) -> http.client.HTTPConnection:
    if address.scheme == "http":
        return http.client.HTTPConnection(address.host, address.port, timeout=timeout_s)
    return http.client.HTTPSConnection(address.host, address.port, timeout=timeout_s, context=_tls())


def _tls() -> ssl.SSLContext:
    """Verify certificates by the system's authorities, else by those that Blender's own Python ships (certifi)."""
    context = ssl.create_default_context()
    places = ssl.get_default_verify_paths()
    if not context.cert_store_stats()["x509_ca"] and not (places.capath and Path(places.capath).is_dir()):
        try:
            import certifi
        except ImportError:
            return context
        context.load_verify_locations(certifi.where())
    return context


def _unpacker(encoding: str) -> Callable[[bytes], bytes] | None:
    """Return a decoder of sent bytes, limited to little more than the allowed size; None for an unknown encoding."""
    if encoding.strip().lower() in ("", "identity"):
        return lambda chunk: chunk
    if encoding.strip().lower() in ("gzip", "x-gzip", "deflate"):
        # 32: a header of zlib or gzip, whichever is there.
        stream = zlib.decompressobj(wbits=zlib.MAX_WBITS | 32)
        return lambda chunk: stream.decompress(chunk, MAX_ANSWER_BYTES + 1)
    return None
