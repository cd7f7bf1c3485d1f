# SPDX-License-Identifier: MIT
"""Ask an OpenAI-compatible chat endpoint one question about one picture.

The key is read from the environment at the moment of sending, is in no message, exception or field, and is cut out of
whatever a server sends back.
"""

from __future__ import annotations

import base64
import email.utils
import json
import math
import os
import re
import time
from collections.abc import Callable
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any
from urllib.parse import urljoin

from ...errors import Cancelled, InputError
from ...events import IsCancelled, never
from .endpoint import Address, Failure, Reply, parse_address, post

DEFAULT_KEY_VARIABLE = "PHYSGEN_API_KEY"
MAX_WAIT_S = 60.0
"""Longest pause between two attempts. A server that asks for a longer one is not asked again."""

MAX_REDIRECTS = 3
_ENDING = "/chat/completions"
_SHORTEST_SECRET = 8


@dataclass(frozen=True, kw_only=True)
class ChatRequest:
    """Whom to ask, and how patiently. Raises InputError on a value that cannot be used.

    url: of the endpoint, http or https: ``https://host``, ``https://host/v1`` or all of
        ``https://host/v1/chat/completions``.
    model: as the endpoint calls it.
    key_variable: environment variable that holds the key. Without one of the default name no key is sent.
    timeout_s: for one attempt, from the start to the last byte of the answer, 0.05 to 3600.
    retries: further attempts where the endpoint is busy (429), fails (5xx) or cannot be reached, 0 to 10.
    backoff_s: pause before the second attempt, 0 to 60; each further one is twice as long.
    consent: the user has agreed that the photo leaves for this endpoint; must be True.
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
            raise InputError("consent: not given; the photo is sent nowhere before you agree to it (--send-photo)")
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
        """Where requests go: ``url`` with what is missing of ``/v1/chat/completions``."""
        address = parse_address(self.url)
        path, mark, query = address.target.partition("?")
        path = path.rstrip("/")
        if not path.endswith(_ENDING):
            path = (path or "/v1") + _ENDING
        return Address(address.scheme, address.host, address.port, path + mark + query)


def complete(
    request: ChatRequest,
    question: str,
    jpeg: bytes,
    notice: Callable[[str], None],
    cancelled: IsCancelled = never,
) -> str:
    """The text that ``request.model`` answers to ``question`` about the picture ``jpeg``.

    ``notice`` is told of attempts that failed and of answers that were cut off; ``cancelled`` is asked between attempts
    and while waiting. Raises InputError when no answer comes, and Cancelled.
    """
    key = _key(request.key_variable)
    place = address = request.address
    if address.scheme == "http" and not address.is_this_machine:
        notice(f"{address}: photo{' and key' if key else ''} travel unencrypted; https would hide them")
    # Equal photos should get equal answers, as far as a model can; a few models refuse a temperature.
    body: dict[str, Any] = {
        "model": request.model,
        "temperature": 0,
        "stream": False,
        "messages": _messages(question, jpeg),
    }
    headers = {
        "Content-Type": "application/json",
        "Accept": "application/json",
        "Accept-Encoding": "identity",
        "User-Agent": "physgen",
        "Connection": "close",
    }
    if key:
        headers["Authorization"] = f"Bearer {key}"
    # Messages name the address that the user gave: what a redirect leads to is the server's text.
    redirects = attempt = 0
    while True:
        reply = post(place, json.dumps(body).encode(), headers, request.timeout_s, cancelled)
        if isinstance(reply, Reply):
            if 200 <= reply.status < 300:
                return _content(reply, address, key, notice)
            if reply.status in (307, 308) and redirects < MAX_REDIRECTS:
                place, redirects = _redirected(place, reply, key), redirects + 1
                continue
            if reply.status == 400 and "temperature" in body and b"temperature" in reply.body:
                del body["temperature"]
                continue
        failure = reply if isinstance(reply, Failure) else _refused(reply, request, key)
        pause = _pause(reply, request.backoff_s * 2.0**attempt)
        if not failure.again or attempt >= request.retries or pause > MAX_WAIT_S:
            tried = f" (tried {attempt + 1} times)" if attempt else ""
            raise InputError(f"{address}: {failure.reason}{tried}; nothing was learnt about the objects")
        attempt += 1
        notice(f"{address}: {failure.reason}; attempt {attempt + 1} of {request.retries + 1} follows in {pause:.3g} s")
        _wait(pause, cancelled)


def _key(variable: str) -> str:
    key = os.environ.get(variable, "").strip()
    if not key and variable != DEFAULT_KEY_VARIABLE:
        raise InputError("key_variable: the environment has no such variable, or an empty one; set it or leave it out")
    if not (key.isascii() and key.isprintable() and " " not in key):
        raise InputError(f"key in the environment: holds characters that no key has; set {DEFAULT_KEY_VARIABLE} anew")
    return key


def _messages(question: str, jpeg: bytes) -> list[dict[str, Any]]:
    picture = "data:image/jpeg;base64," + base64.b64encode(jpeg).decode("ascii")
    parts = [{"type": "text", "text": question}, {"type": "image_url", "image_url": {"url": picture}}]
    return [{"role": "user", "content": parts}]


def _redirected(address: Address, reply: Reply, key: str) -> Address:
    """Where a redirect leads. Raises InputError unless it stays with scheme, host and port."""
    found = _led_to(address, reply.headers.get("location", ""))
    if found is None or (found.scheme, found.host, found.port) != (address.scheme, address.host, address.port):
        where = f" to host {_shown(found.host, key, 80)!r}" if found is not None else ""
        raise InputError(
            f"{address}: redirects{where}; the photo goes to the host that you named only, name the right one"
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
        # Such answers like to repeat the key, in part or masked; nothing of them is shown.
        return Failure(
            f"refuses the key (status {status}); check the key in the variable of the environment", again=False
        )
    if status == 404:
        return Failure(f"has no such path or model (404); check the URL and the model {request.model!r}", again=False)
    if 300 <= status < 400:
        return Failure(f"redirects (status {status}); give the address that it leads to", again=False)
    said = _said(reply.body, key)
    reason = f"answers with status {status}" + (f": {said}" if said else "")
    return Failure(reason, again=status in (408, 425, 429) or (status >= 500 and status not in (501, 505)))


def _said(body: bytes, key: str) -> str:
    """The server's own words, in one printable line without the key; "" where it sent none or they may hold it."""
    data = _parsed(body)
    error = data.get("error", data.get("message", data.get("detail"))) if isinstance(data, dict) else None
    text = error.get("message") if isinstance(error, dict) else error
    return _shown(text, key, 200) if isinstance(text, str) else ""


def _shown(text: str, key: str, limit: int) -> str:
    """What a server said as one printable line; "" beside a key that is too short to be told from other words."""
    if 0 < len(key) < _SHORTEST_SECRET:
        return ""
    text = _without(text, key)
    plain = " ".join("".join(c if c.isprintable() else " " for c in text[: 4 * limit]).split())
    return plain if len(plain) <= limit else plain[: limit - 1] + "…"


def _without(text: str, key: str) -> str:
    return re.sub(re.escape(key), "***", text, flags=re.IGNORECASE) if len(key) >= _SHORTEST_SECRET else text


def _pause(reply: Reply | Failure, backoff: float) -> float:
    """Seconds to wait: what the server asks for (RFC 9110, 10.2.3: seconds or a date), at least ``backoff``."""
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
            raise Cancelled("asking about the photo was cancelled")
        left = end - time.monotonic()
        if left <= 0:
            return
        time.sleep(min(0.05, left))


def _content(reply: Reply, address: Address, key: str, notice: Callable[[str], None]) -> str:
    """The answer's text. Raises InputError when the reply holds none."""
    data = _parsed(reply.body)
    if data is None:
        start = reply.body.lstrip()[:1]
        what = "nothing" if not start else "a web page" if start == b"<" else "something that is not JSON"
        raise InputError(f"{address}: answers with {what}; is it a chat endpoint? Its path ends in {_ENDING}")
    data = data if isinstance(data, dict) else {}
    if data.get("error"):
        raise InputError(f"{address}: answers with an error: {_said(reply.body, key) or 'without a message'}")
    choices = data.get("choices")
    choice = choices[0] if isinstance(choices, list) and choices and isinstance(choices[0], dict) else {}
    message = choice.get("message")
    message = message if isinstance(message, dict) else {}
    text = _without(_text(message.get("content")), key).strip()
    if text:
        if choice.get("finish_reason") == "length":
            notice(f"{address}: the answer was cut off at the model's limit; what is there is used")
        return text
    refusal = message.get("refusal")
    if isinstance(refusal, str) and refusal.strip():
        raise InputError(f"{address}: the model refuses: {_shown(refusal, key, 200)}")
    if message.get("tool_calls"):
        raise InputError(f"{address}: the model calls a tool and says nothing; choose a model that answers in words")
    stopped = _shown(str(choice.get("finish_reason", "unknown")), key, 40)
    raise InputError(f"{address}: the reply holds no text (finish_reason {stopped}); choose a model that reads images")


def _parsed(body: bytes) -> Any:
    """The JSON value of ``body``; None where it is none. Its error would carry the whole body along, and dies here."""
    try:
        return json.loads(body)
    except (ValueError, RecursionError):
        return None


def _text(content: object) -> str:
    """Text of a message's content: a string, or a list of parts of which some are text."""
    if isinstance(content, str):
        return content
    if not isinstance(content, list):
        return ""
    texts = [part.get("text") for part in content if isinstance(part, dict)] + [
        p for p in content if isinstance(p, str)
    ]
    return "\n".join(text for text in texts if isinstance(text, str))
