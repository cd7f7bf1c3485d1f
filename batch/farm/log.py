# SPDX-License-Identifier: GPL-3.0-or-later
"""What a task says, on the disk while it runs, and never more than a bounded amount of it."""

from __future__ import annotations

from collections import deque
from pathlib import Path
from types import TracebackType

from ...sim.errors import InputError

HEAD_BYTES = 256 * 1024
TAIL_BYTES = 256 * 1024
EARLIER_BYTES = 64 * 1024
"""Of the attempts before, kept at the beginning."""


class TaskLog:
    """The log of one attempt: its beginning as it comes, and its end when it is closed.

    Raises InputError when it cannot be written; what comes later is dropped then, so that a full disk does not stop a
    task that needs no more of it.
    """

    def __init__(self, path: Path, title: str) -> None:
        self.path = path
        self._left = HEAD_BYTES
        self._tail: deque[bytes] = deque()
        self._tail_bytes = self._dropped = 0
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            earlier = path.read_bytes()[-EARLIER_BYTES:] if path.is_file() else b""
            self._file = path.open("wb", buffering=0)
            self._file.write(earlier + f"==== {title}\n".encode())
        except OSError as error:
            raise InputError(
                f"{path}: cannot be written ({error.strerror or error}); free space or choose another folder"
            ) from error

    def write(self, line: bytes) -> None:
        """Add one line."""
        line = line.rstrip(b"\r\n") + b"\n"
        if len(line) <= self._left:
            self._left -= len(line)
            self._put(line)
            return
        self._left = 0
        self._tail.append(line)
        self._tail_bytes += len(line)
        while self._tail_bytes > TAIL_BYTES:
            self._tail_bytes -= len(self._tail.popleft())
            self._dropped += 1

    def close(self) -> None:
        """Write the end and close the file."""
        if self._dropped:
            self._put(f"… {self._dropped} lines left out …\n".encode())
        self._put(b"".join(self._tail))
        self._file.close()

    def _put(self, content: bytes) -> None:
        try:
            self._file.write(content)
        except OSError:
            self._left = 0

    def __enter__(self) -> TaskLog:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def log_end(path: Path, most: int = 4096) -> str:
    """The last ``most`` bytes of a log, from the beginning of a line; empty when there is none."""
    try:
        with path.open("rb") as file:
            size = file.seek(0, 2)
            file.seek(max(0, size - most))
            content = file.read()
    except OSError:
        return ""
    if size > most:
        content = content.partition(b"\n")[2]
    return content.decode("utf-8", "replace")
