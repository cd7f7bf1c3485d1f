# SPDX-License-Identifier: GPL-3.0-or-later
"""A command's terminal: progress as text or as JSON lines, and requests to stop."""

from __future__ import annotations

import json
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TextIO

from ..sim.events import Event, IsCancelled

STOP_S = 1.3
"""A command has ended so long after it was asked to stop, by itself or not."""


@contextmanager
def stop_signals(at_last: Callable[[], object] | None = None) -> Iterator[IsCancelled]:
    """Yield a function that returns whether SIGINT or SIGTERM arrived since; the former handlers return at the end.

    at_last: called by another thread, ``STOP_S`` after the signal, if the work has not ended by then; it ends the
    process. For the main thread: only there Python allows handlers.
    """
    stop, done = threading.Event(), threading.Event()
    former = {number: signal.signal(number, lambda *_: stop.set()) for number in (signal.SIGINT, signal.SIGTERM)}
    # Python's handlers wait until the main thread's present call into a library is over; the pipe is written at once.
    reading, writing = os.pipe()
    if os.name != "nt":
        os.set_blocking(writing, False)
    earlier = signal.set_wakeup_fd(writing, warn_on_full_buffer=False)

    def watch() -> None:
        while not done.is_set() and os.read(reading, 1) not in (b"", b"\0"):
            stop.set()
            if at_last is not None and not done.wait(STOP_S):
                at_last()

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


class Terminal:
    """Print events: one updating line on a terminal, occasional lines in a log, or JSON lines."""

    def __init__(self, *, as_json: bool, expected_s: dict[str, float] | None = None, out: TextIO | None = None) -> None:
        """expected_s: initial guess for each stage; out: stream to write to, standard output by default."""
        self._json = as_json
        self._out: TextIO = out or sys.stdout
        self._live = not as_json and self._out.isatty()
        self._started = time.monotonic()
        # Stages that have not started count with a guess, so that the remaining time is that of the whole job.
        self._left = dict(expected_s or {})
        self._last_line = 0.0
        self.reader_gone = False
        self._open_line = False

    def __call__(self, event: Event) -> None:
        """Print ``event``."""
        kind, stage = event.get("event"), str(event.get("stage", ""))
        if kind == "progress":
            done, total, eta = int(event["done"]), int(event["total"]), event.get("eta_s")
            if eta is not None:
                self._left[stage] = float(eta)
            if done >= total:
                self._left[stage] = 0.0
            event = {**event, "job_eta_s": round(sum(self._left.values()), 1)}
        if self._json:
            self._write(json.dumps(event, ensure_ascii=False) + "\n")
        elif kind == "progress":
            self._progress(event, stage)
        elif "message" in event:
            self.line(f"{stage + ': ' if stage else ''}{event['message']}")

    def _write(self, text: str) -> None:
        try:
            self._out.write(text)
            self._out.flush()
        except BrokenPipeError:
            # As in ``physgen … | head -1``: the reader has gone, which means stop, not crash.
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
        left = _clock(float(event["job_eta_s"]))
        text = (
            f"{stage:<11} {done:>4}/{total:<4} {message:<22} {_clock(now - self._started)} elapsed, about {left} left"
        )
        if self._live:
            self._write("\r\x1b[K" + text + ("\n" if finished else ""))
            self._open_line = not finished
        else:
            self._write(text + "\n")

    def line(self, text: str) -> None:
        """Print one line of text, below a progress line that is being updated."""
        if self._json:
            return
        self._write(("\n" if self._open_line else "") + text + "\n")
        self._open_line = False

    def error(self, kind: str, message: str) -> None:
        """Report the error that ends the run."""
        if self._json:
            self._write(json.dumps({"event": "error", "kind": kind, "message": message}, ensure_ascii=False) + "\n")
        else:
            sys.stderr.write(("\n" if self._open_line else "") + f"error: {message}\n")


def _clock(seconds: float) -> str:
    whole = round(seconds)
    return f"{whole // 60}:{whole % 60:02d}"
