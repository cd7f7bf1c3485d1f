# SPDX-License-Identifier: GPL-3.0-or-later
"""A command's terminal: progress as text or as JSON lines, and requests to stop."""

from __future__ import annotations

import contextlib
import errno
import io
import json
import math
import os
import re
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TextIO

from ..sim.app.launch import STOP_SIGNALS
from ..sim.events import Event, IsCancelled, stage_words

STOP_S = 1.3
"""A command has ended so long after it was asked to stop, by itself or not."""


@contextmanager
def stop_signals(on_timeout: Callable[[], object] | None = None) -> Iterator[IsCancelled]:
    """Yield a function that returns whether one of ``STOP_SIGNALS`` has arrived; the former handlers return at the end.

    on_timeout: called by another thread, ``STOP_S`` after the signal, if the work has not ended by then; it ends the
    process. For the main thread: only there Python allows handlers.
    """
    stop, done = threading.Event(), threading.Event()
    former = {number: signal.signal(number, lambda *_: stop.set()) for number in STOP_SIGNALS}
    # Python's handlers wait until the main thread's present call into a library is over; the pipe is written at once.
    reading, writing = os.pipe()
    if os.name != "nt":
        os.set_blocking(writing, False)
    earlier = signal.set_wakeup_fd(writing, warn_on_full_buffer=False)

    def watch() -> None:
        while not done.is_set() and os.read(reading, 1) not in (b"", b"\0"):
            stop.set()
            if on_timeout is not None and not done.wait(STOP_S):
                on_timeout()

    watcher = threading.Thread(target=watch, name="physgen-signals", daemon=True)
    watcher.start()
    try:
        yield stop.is_set
    finally:
        signal.set_wakeup_fd(earlier)
        done.set()
        os.write(writing, b"\0")
        watcher.join(timeout=5)
        os.close(writing)
        os.close(reading)
        for number, handler in former.items():
            # None: installed by C code, which Python can't put back.
            if handler is not None:
                signal.signal(number, handler)


SLOWEST = 20.0
"""Most times that a machine is taken to be slower than guessed."""


class RemainingTime:
    """Seconds that a job of several stages has left, from its progress events and a first guess for each stage.

    A stage's own estimate is taken where it gives one, else its pace, and its guess while it has hardly begun. What has
    not begun counts with its guess, times how much slower than guessed the finished stages were.
    """

    def __init__(self, expected_s: dict[str, float], *, clock: Callable[[], float] = time.monotonic) -> None:
        self._expected = dict(expected_s)
        self._clock = clock
        self._begun: dict[str, float] = {}
        self._done: dict[str, float] = {}
        self._left: dict[str, float] = {}
        self._slowness = 1.0

    def update(self, event: Event) -> float:
        """Take a progress event; return the seconds left of the whole job."""
        stage, done, total = str(event.get("stage", "")), float(event["done"]), float(event["total"])
        now = self._clock()
        if done < self._done.get(stage, math.inf):
            # A first event, or a stage that begins anew, such as a second rehearsal.
            self._begun[stage] = now
        self._done[stage] = done
        elapsed = now - self._begun[stage]
        guess = self._expected.get(stage, 0.0) * self._slowness
        if done >= total:
            self._left[stage] = 0.0
            if stage in self._expected:
                # What was cached or resumed is fast, and says nothing of the machine.
                self._slowness = min(max(self._slowness, elapsed / self._expected[stage]), SLOWEST)
        elif event.get("eta_s") is not None:
            self._left[stage] = float(event["eta_s"])
        else:
            part = done / total if total > 0 else 0.0
            by_pace = elapsed * (1 - part) / part if part > 0 else 0.0
            self._left[stage] = part * by_pace + (1 - part) * max(guess - elapsed, elapsed * (1 - part))
        waiting = sum(value for name, value in self._expected.items() if name not in self._left)
        return sum(self._left.values()) + waiting * self._slowness


_UNSEEN = re.compile("[\x00-\x08\x0b-\x1f\x7f-\x9f\u061c\u200e\u200f\u2028-\u202e\u2066-\u2069\ud800-\udfff]")
"""Characters that a terminal obeys instead of showing them: escape sequences set its title, hide or move what it shows,
and some answer as if the user had typed; bidirectional controls reorder a line. Lone halves of characters cannot be
written at all. Line feeds and tabs are ours."""


def printable(text: str) -> str:
    """Return ``text`` for a terminal: what names from a stranger's folder may hold besides text is replaced."""
    return _UNSEEN.sub("\N{REPLACEMENT CHARACTER}", text)


def tolerant(stream: TextIO) -> TextIO:
    """Have ``stream`` write what its encoding lacks (ASCII, a code page of Windows) as ``\\u2192``; return it."""
    if isinstance(stream, io.TextIOWrapper):
        stream.reconfigure(errors="backslashreplace")
    return stream


def json_line(value: Event, encoding: str) -> str:
    """Return ``value`` as one line of JSON in ``encoding``: the same value for a program, harmless on a terminal."""
    text = json.dumps(value, ensure_ascii=not encoding.lower().startswith("utf"))
    return _UNSEEN.sub(lambda at: f"\\u{ord(at[0]):04x}", text) + "\n"


class Terminal:
    """Print events: one updating line on a terminal, occasional lines in a log, or JSON lines."""

    def __init__(self, *, as_json: bool, expected_s: dict[str, float] | None = None, out: TextIO | None = None) -> None:
        """expected_s: initial guess for each stage; out: stream to write to, standard output by default."""
        self._json = as_json
        self._out: TextIO = tolerant(out or sys.stdout)
        self._live = not as_json and self._out.isatty()
        self._started = time.monotonic()
        self._remaining = RemainingTime(expected_s or {})
        self._last_line = 0.0
        self.reader_gone = False
        self._open_line = False

    def __call__(self, event: Event) -> None:
        """Print ``event``."""
        kind, stage = event.get("event"), str(event.get("stage", ""))
        if kind == "progress":
            event = {**event, "job_eta_s": round(self._remaining.update(event), 1)}
        if self._json:
            self._write_json(event)
        elif kind == "progress":
            self._progress(event, stage)
        elif "message" in event:
            self.line(f"{stage + ': ' if stage else ''}{event['message']}")

    def _write_json(self, event: Event) -> None:
        self._write(json_line(event, self._out.encoding or "utf-8"))

    def _write(self, text: str) -> None:
        try:
            self._out.write(text)
            self._out.flush()
        except OSError as error:
            # As in ``physgen … | head -1``, or a terminal that was closed: the reader has gone, which means stop.
            if error.errno not in (errno.EPIPE, errno.EIO):
                raise
            self.reader_gone = True
            os.dup2(os.open(os.devnull, os.O_WRONLY), self._out.fileno())

    def _progress(self, event: Event, stage: str) -> None:
        done, total = int(event["done"]), int(event["total"])
        now = time.monotonic()
        finished = done >= total
        if not self._live and not finished and now - self._last_line < 5.0:
            return
        self._last_line = now
        message = str(event.get("message") or event.get("step") or "")
        left = float(event["job_eta_s"])
        text = f"{stage_words(stage):<17} {done:>4}/{total:<4} {message:<22} {_clock(now - self._started)} elapsed"
        if left >= 1.0:
            # Less is not known: a stage that has ended, or whose pace has not shown yet, is no promise.
            text += f", about {_clock(left)} left"
        text = printable(text).replace("\n", " ")
        if self._live:
            self._write("\r\x1b[K" + text + ("\n" if finished else ""))
            self._open_line = not finished
        else:
            self._write(text + "\n")

    def line(self, text: str) -> None:
        """Print one line of text, below a progress line that is being updated."""
        if self._json:
            return
        self._write(("\n" if self._open_line else "") + printable(text) + "\n")
        self._open_line = False

    def error(self, kind: str, message: str) -> None:
        """Report the error that ends the run."""
        # Where even that cannot be written, the exit code says it.
        with contextlib.suppress(OSError):
            if self._json:
                self._write_json({"event": "error", "kind": kind, "message": message})
            else:
                tolerant(sys.stderr).write(("\n" if self._open_line else "") + f"error: {printable(message)}\n")
                sys.stderr.flush()


def _clock(seconds: float) -> str:
    whole = round(seconds)
    return f"{whole // 60}:{whole % 60:02d}"
