# SPDX-License-Identifier: MIT
"""One POST to one address: bounded in time and size, never led elsewhere, given up when asked to.

http.client is used as it is: it reads no proxy settings, follows no redirect and keeps no cookies, so what is sent
goes to the host of the address and to nobody else.
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
"""Of a body, packed and unpacked; answers have a few hundred."""

_CHUNK = 2**16
_POLL_S = 0.05


@dataclass(frozen=True)
class Address:
    """Where to send: scheme ``http`` or ``https``, host, port, and the path with its query."""

    scheme: str
    host: str
    port: int
    target: str

    def __str__(self) -> str:
        """For messages: without the query, which may hold secrets."""
        host = f"[{self.host}]" if ":" in self.host else self.host
        return f"{self.scheme}://{host}:{self.port}{self.target.partition('?')[0]}"

    @property
    def is_this_machine(self) -> bool:
        """Whether nothing leaves the computer."""
        return self.host in ("localhost", "::1") or re.fullmatch(r"127(\.\d{1,3}){3}", self.host) is not None


@dataclass(frozen=True)
class Reply:
    """What came back: ``status``, headers by lower-case name, and the unpacked body."""

    status: int
    headers: Mapping[str, str] = field(repr=False)
    body: bytes = field(repr=False)


@dataclass(frozen=True)
class Failure:
    """Why nothing usable came back, and whether another attempt may help."""

    reason: str
    again: bool


def parse_address(url: str) -> Address:
    """The address ``url``. Raises InputError, which does not repeat what a URL may hold of secrets."""
    # Errors of urlsplit repeat the URL, so ours are not raised while one of them is handled.
    parts = _split(url)
    if parts is None:
        raise InputError("url: is no address; give one like https://host/v1")
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
    """Send ``body`` to ``address`` and wait for all of the answer, at most ``timeout_s`` from now.

    A second thread does the waiting, so that a server that sends a byte now and then cannot outlast the time-out, and
    ``cancelled`` is asked all the while. Raises Cancelled only; all that can go wrong with a network is a Failure.
    """
    exchange = _Exchange(address, body, headers, timeout_s)
    deadline = time.monotonic() + timeout_s
    worker = threading.Thread(target=exchange.run, name="physgen-chat", daemon=True)
    worker.start()
    try:
        while True:
            if cancelled():
                raise Cancelled("asking about the photo was cancelled")
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
    """One connection, used by one thread; another may hang up."""

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
            # The message of these repeats what the server sent.
            lost = isinstance(error, http.client.RemoteDisconnected)
            self.outcome.put(Failure("hung up without an answer" if lost else "does not speak HTTP", again=lost))
        except (OSError, http.client.HTTPException, zlib.error, ValueError) as error:
            said = error.strerror if isinstance(error, OSError) and error.strerror else type(error).__name__
            self.outcome.put(Failure(f"broke the connection off or could not be reached ({said})", again=True))
        finally:
            self._connection.close()

    def hang_up(self) -> None:
        """Wake the thread if it still waits for the network."""
        self._given_up.set()
        wire = self._connection.sock
        if wire is not None:
            try:
                # Of the plain socket: a TLS socket would take its state from under the waiting thread.
                socket.socket.shutdown(wire, socket.SHUT_RDWR)
            except OSError:
                return

    def _talk(self) -> Reply | Failure:
        with contextlib.suppress(BrokenPipeError, ConnectionResetError):
            # A server that refuses early hangs up while we send; its answer may be there all the same.
            self._connection.request("POST", self._address.target, self._body, dict(self._headers))
        response = self._connection.getresponse()
        headers = {name.lower(): value for name, value in response.getheaders()}
        unpack = _unpacker(headers.get("content-encoding", "identity"))
        if unpack is None:
            return Failure("packs its answer in a way that is not understood (Content-Encoding)", again=False)
        packed, body = 0, bytearray()
        while chunk := response.read1(_CHUNK):
            packed += len(chunk)
            body += unpack(chunk)
            if max(packed, len(body)) > MAX_ANSWER_BYTES:
                return Failure(f"sends more than {MAX_ANSWER_BYTES >> 20} MiB, which is no answer", again=False)
        if response.length:
            return Failure("broke off in the middle of its answer", again=True)
        return Reply(response.status, headers, bytes(body))


def _connection(address: Address, timeout_s: float) -> http.client.HTTPConnection:
    if address.scheme == "http":
        return http.client.HTTPConnection(address.host, address.port, timeout=timeout_s)
    return http.client.HTTPSConnection(address.host, address.port, timeout=timeout_s, context=_tls())


def _tls() -> ssl.SSLContext:
    """Verify certificates by the system's authorities, else by those that Blender's own Python brings (certifi)."""
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
    """Bytes as sent → bytes of the body, at most a little more than allowed; None for an unknown encoding."""
    if encoding.strip().lower() in ("", "identity"):
        return lambda chunk: chunk
    if encoding.strip().lower() in ("gzip", "x-gzip", "deflate"):
        # 32: a header of zlib or gzip, whichever is there.
        stream = zlib.decompressobj(wbits=zlib.MAX_WBITS | 32)
        return lambda chunk: stream.decompress(chunk, MAX_ANSWER_BYTES + 1)
    return None
