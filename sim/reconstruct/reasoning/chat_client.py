# SPDX-License-Identifier: MIT
"""Client of OpenAI-compatible chat endpoints: one question about one picture or several.

The key is read from the environment when it is sent, is in no message, exception or field, and is redacted from server
responses.
"""

from __future__ import annotations

import base64
import email.utils
import json
import math
import os
import re
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any
from urllib.parse import urljoin

from ...errors import Cancelled, InputError
from ...events import IsCancelled, never
from .http_post import Address, Failure, Reply, parse_address, post

DEFAULT_KEY_VARIABLE = "PHYSGEN_API_KEY"
MAX_WAIT_S = 60.0
"""Longest pause between two attempts; a server that asks for a longer one is not retried."""

MAX_REDIRECTS = 3
_ENDING = "/chat/completions"
_SHORTEST_SECRET = 8


@dataclass(frozen=True, kw_only=True)
class ChatRequest:
    """Endpoint and retry policy. Raises InputError on an invalid value.

    url: of the endpoint, http or https: ``https://host``, ``https://host/v1`` or the full
        ``https://host/v1/chat/completions``.
    model: its name at the endpoint.
    key_variable: environment variable with the key. If the default one is not set, no key is sent.
    timeout_s: for one attempt, from the start to the last byte of the answer, 0.05 to 3600.
    retries: further attempts if the endpoint is busy (429), fails (5xx) or cannot be reached, 0 to 10.
    backoff_s: pause before the second attempt, 0 to 60; it doubles with each further one.
    consent: the user agrees that the photo or the frames are sent to this endpoint; must be True.
    """

    url: str
    model: str
    key_variable: str = DEFAULT_KEY_VARIABLE
    timeout_s: float = 90.0
    retries: int = 2
    backoff_s: float = 1.0
    consent: bool = False

    def __post_init__(self) -> None:
        if self.consent is not True:
            raise InputError(
                "consent: not given; no photo or frame is sent without your agreement (--send-photo, --send-frames)"
            )
        parse_address(self.url)
        if not (0 < len(self.model) <= 200 and self.model.isprintable()):
            raise InputError(f"model is {self.model[:60]!r}: give the name that the endpoint knows")
        if not re.fullmatch(r"[A-Za-z_][A-Za-z0-9_]{0,99}", self.key_variable):
            # Not repeated: it may be the key itself.
            raise InputError("key_variable: is no name of an environment variable; give a name, not the key")
        for name, low, high in (("timeout_s", 0.05, 3600.0), ("retries", 0, 10), ("backoff_s", 0.0, MAX_WAIT_S)):
            value = getattr(self, name)
            if not (math.isfinite(value) and low <= value <= high):
                raise InputError(f"{name} is {value!r}: give {low:g} to {high:g}")

    @property
    def address(self) -> Address:
        """The request address: ``url`` with any missing part of ``/v1/chat/completions``."""
        address = parse_address(self.url)
        path, mark, query = address.target.partition("?")
        path = path.rstrip("/")
        if not path.endswith(_ENDING):
            path = (path or "/v1") + _ENDING
        return Address(address.scheme, address.host, address.port, path + mark + query)


@dataclass(frozen=True, kw_only=True)
class Wording:
    """Words of messages for the pictures that are sent, and for what did not happen where no answer arrives."""

    sent: str = "photo"
    lost: str = "the objects were not identified"


PHOTO = Wording()


def complete_chat(
    request: ChatRequest,
    question: str,
    jpeg: bytes,
    notice: Callable[[str], None],
    cancelled: IsCancelled = never,
) -> str:
    """Return the answer of ``request.model`` to ``question`` about ``jpeg``, as ``complete_content`` does."""
    return complete_content(request, (question, jpeg), notice, cancelled)


def complete_content(
    request: ChatRequest,
    content: Sequence[str | bytes],
    notice: Callable[[str], None],
    cancelled: IsCancelled = never,
    *,
    temperature: float | None = 0.0,
    wording: Wording = PHOTO,
) -> str:
    """Return the answer of ``request.model`` to one message of texts and JPEG files, in the order of ``content``.

    ``notice`` receives failed attempts and truncated answers; ``cancelled`` is polled between attempts and while
    waiting. temperature: 0 for repeatable answers; None for the model's own. Raises InputError if no answer arrives,
    and Cancelled.
    """
    key = _key(request.key_variable)
    place = address = request.address
    if address.scheme == "http" and not address.is_this_machine:
        notice(f"{address}: {wording.sent}{' and key' if key else ''} are sent unencrypted; use https")
    body: dict[str, Any] = {
        "model": request.model,
        "stream": False,
        "messages": [{"role": "user", "content": [_part(piece) for piece in content]}],
    }
    if temperature is not None:
        body["temperature"] = temperature
    headers = {
        "Content-Type": "application/json",
        "Accept": "application/json",
        "Accept-Encoding": "identity",
        "User-Agent": "physgen",
        "Connection": "close",
    }
    if key:
        headers["Authorization"] = f"Bearer {key}"
    # Messages name the user's address: the target of a redirect is text from the server.
    redirects = attempt = 0
    while True:
        reply = post(place, json.dumps(body).encode(), headers, request.timeout_s, cancelled)
        if isinstance(reply, Reply):
            if 200 <= reply.status < 300:
                return _content(reply, address, key, notice)
            if reply.status in (307, 308) and redirects < MAX_REDIRECTS:
                place, redirects = _redirected(place, reply, key, wording.sent), redirects + 1
                continue
            # A few models reject the parameter.
            if reply.status == 400 and "temperature" in body and b"temperature" in reply.body:
                del body["temperature"]
                continue
        failure = reply if isinstance(reply, Failure) else _refused(reply, request, key)
        pause = _pause(reply, request.backoff_s * 2.0**attempt)
        if not failure.again or attempt >= request.retries or pause > MAX_WAIT_S:
            tried = f" (tried {attempt + 1} times)" if attempt else ""
            raise InputError(f"{address}: {failure.reason}{tried}; {wording.lost}")
        attempt += 1
        notice(f"{address}: {failure.reason}; attempt {attempt + 1} of {request.retries + 1} follows in {pause:.3g} s")
        _wait(pause, cancelled)


def _key(variable: str) -> str:
    key = os.environ.get(variable, "").strip()
    if not key and variable != DEFAULT_KEY_VARIABLE:
        raise InputError("key_variable: the environment has no such variable, or an empty one; set it or leave it out")
    if not (key.isascii() and key.isprintable() and " " not in key):
        raise InputError(
            f"key in the environment: contains characters that a key cannot have; set {DEFAULT_KEY_VARIABLE} again"
        )
    return key


def _part(piece: str | bytes) -> dict[str, Any]:
    if isinstance(piece, str):
        return {"type": "text", "text": piece}
    return {"type": "image_url", "image_url": {"url": picture_url(piece)}}


def picture_url(jpeg: bytes) -> str:
    """Return a data URL of the JPEG file."""
    return "data:image/jpeg;base64," + base64.b64encode(jpeg).decode("ascii")


def _redirected(address: Address, reply: Reply, key: str, sent: str) -> Address:
    """The target of a redirect. Raises InputError unless scheme, host and port stay the same."""
    found = _led_to(address, reply.headers.get("location", ""))
    if found is None or (found.scheme, found.host, found.port) != (address.scheme, address.host, address.port):
        where = f" to host {_shown(found.host, key, 80)!r}" if found is not None else ""
        raise InputError(
            f"{address}: redirects{where}; {sent} and question go only to the host that you gave; give the right one"
        )
    return found


def _led_to(address: Address, place: str) -> Address | None:
    host = f"[{address.host}]" if ":" in address.host else address.host
    try:
        return parse_address(urljoin(f"{address.scheme}://{host}:{address.port}{address.target}", place))
    except (ValueError, InputError):
        return None


def _refused(reply: Reply, request: ChatRequest, key: str) -> Failure:
    status = reply.status
    if status in (401, 403):
        # Such responses may repeat the key, in part or masked; show nothing of them.
        return Failure(
            f"refuses the key (status {status}); check the key in the variable of the environment", again=False
        )
    if status == 404:
        return Failure(f"has no such path or model (404); check the URL and the model {request.model!r}", again=False)
    if 300 <= status < 400:
        return Failure(f"redirects (status {status}); give its target instead", again=False)
    detail = _server_message(reply.body, key)
    reason = f"answers with status {status}" + (f": {detail}" if detail else "")
    return Failure(reason, again=status in (408, 425, 429) or (status >= 500 and status not in (501, 505)))


def _server_message(body: bytes, key: str) -> str:
    """The server's message, as one printable line without the key; "" if there is none or it may contain the key."""
    data = _parsed(body)
    error = data.get("error", data.get("message", data.get("detail"))) if isinstance(data, dict) else None
    text = error.get("message") if isinstance(error, dict) else error
    return _shown(text, key, 200) if isinstance(text, str) else ""


def _shown(text: str, key: str, limit: int) -> str:
    """Server text as one printable line; "" if the key is too short to be recognised in it."""
    if 0 < len(key) < _SHORTEST_SECRET:
        return ""
    text = _without(text, key)
    plain = " ".join("".join(c if c.isprintable() else " " for c in text[: 4 * limit]).split())
    return plain if len(plain) <= limit else plain[: limit - 1] + "…"


def _without(text: str, key: str) -> str:
    return re.sub(re.escape(key), "***", text, flags=re.IGNORECASE) if len(key) >= _SHORTEST_SECRET else text


def _pause(reply: Reply | Failure, backoff: float) -> float:
    """Seconds to wait: the server's Retry-After (RFC 9110, 10.2.3: seconds or a date), at least ``backoff``."""
    asked = reply.headers.get("retry-after", "").strip() if isinstance(reply, Reply) else ""
    if re.fullmatch(r"\d{1,9}(\.\d{1,9})?", asked):
        return max(float(asked), 0.0) or min(backoff, MAX_WAIT_S)
    if asked:
        try:
            moment = email.utils.parsedate_to_datetime(asked)
            moment = moment if moment.tzinfo else moment.replace(tzinfo=UTC)
            return max((moment - datetime.now(UTC)).total_seconds(), min(backoff, MAX_WAIT_S))
        except (TypeError, ValueError, OverflowError):
            return min(backoff, MAX_WAIT_S)
    return min(backoff, MAX_WAIT_S)


def _wait(seconds: float, cancelled: IsCancelled) -> None:
    end = time.monotonic() + seconds
    while True:
        if cancelled():
            raise Cancelled("the query about the photo was cancelled")
        left = end - time.monotonic()
        if left <= 0:
            return
        time.sleep(min(0.05, left))


def _content(reply: Reply, address: Address, key: str, notice: Callable[[str], None]) -> str:
    """The answer's text. Raises InputError if the reply has none."""
    data = _parsed(reply.body)
    if data is None:
        start = reply.body.lstrip()[:1]
        what = "nothing" if not start else "a web page" if start == b"<" else "something that is not JSON"
        raise InputError(f"{address}: answers with {what}; is it a chat endpoint? Its path ends in {_ENDING}")
    data = data if isinstance(data, dict) else {}
    if data.get("error"):
        raise InputError(f"{address}: answers with an error: {_server_message(reply.body, key) or 'without a message'}")
    choices = data.get("choices")
    choice = choices[0] if isinstance(choices, list) and choices and isinstance(choices[0], dict) else {}
    message = choice.get("message")
    message = message if isinstance(message, dict) else {}
    text = _without(_text(message.get("content")), key).strip()
    if text:
        if choice.get("finish_reason") == "length":
            notice(f"{address}: the answer was cut off at the model's limit; the rest is used")
        return text
    refusal = message.get("refusal")
    if isinstance(refusal, str) and refusal.strip():
        raise InputError(f"{address}: the model refuses: {_shown(refusal, key, 200)}")
    if message.get("tool_calls"):
        raise InputError(f"{address}: the model calls a tool and returns no text; choose a model that answers in text")
    stopped = _shown(str(choice.get("finish_reason", "unknown")), key, 40)
    raise InputError(f"{address}: the reply holds no text (finish_reason {stopped}); choose a model that reads images")


def _parsed(body: bytes) -> Any:
    """The JSON value of ``body``; None if invalid. The parser's error would contain the whole body, so it is dropped
    here."""
    try:
        return json.loads(body)
    except (ValueError, RecursionError):
        return None


def _text(content: object) -> str:
    """Text of a message's content: a string, or a list with text parts."""
    if isinstance(content, str):
        return content
    if not isinstance(content, list):
        return ""
    texts = [part.get("text") for part in content if isinstance(part, dict)] + [
        p for p in content if isinstance(p, str)
    ]
    return "\n".join(text for text in texts if isinstance(text, str))
