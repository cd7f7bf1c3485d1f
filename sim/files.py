# SPDX-License-Identifier: MIT
"""The gate through which files are read: regular files only, of bounded size, inside their folder.

A name may lead to a pipe without a writer, to an endless device, or to a terabyte. So a file is opened
without waiting, looked at through the open descriptor, and never read further than its kind may be long.
"""

from __future__ import annotations

import contextlib
import errno
import io
import os
import stat
import tomllib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from .errors import InputError

OF_PHYSGEN = "file of PhysGen"
MOST_HASHED = 2**40
"""Of a file of which only a hash is taken, so that memory does not matter."""
MAX_PICTURE_BYTES = 2**30
"""Of a picture's file; how many pixels it may have is its reader's to say."""
PICTURE_FORMATS = ("PNG", "JPEG", "TIFF", "WEBP", "BMP", "GIF", "PPM", "TGA")
"""Pillow's names of what it may decode, whatever the file is called; JPEG includes MPO. PostScript is not among them:
for it, Pillow starts Ghostscript, which runs what the file says."""

VIDEO_VARIABLE = "OPENCV_FFMPEG_CAPTURE_OPTIONS"
VIDEO_FORMATS = (
    "mov", "matroska", "avi", "mpegts", "mpeg", "mpegvideo", "m4v", "h264", "hevc", "ogg", "flv", "asf", "gif", "ivf",
    "mxf", "dv", "yuv4mpegpipe",
)  # fmt: skip
"""FFmpeg's names of what a video may be: files that hold their pictures themselves. Playlists (HLS, concat, DASH, SDP)
are not among them: whatever such a file is called, FFmpeg opens what it names, anywhere, and waits for it."""
_VIDEO_BOUNDS = f"format_whitelist;{','.join(VIDEO_FORMATS)}|protocol_whitelist;file"

_FLAGS = os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0) | getattr(os, "O_NOCTTY", 0)


def open_file(path: Path, most: int, *, what: str = OF_PHYSGEN, folder: Path | None = None) -> io.BufferedReader:
    """Return the regular file ``path``, of at most ``most`` bytes, open for reading; the caller closes it.

    what: kind of file, for the message. folder: where the file must lie, links followed; None: anywhere.

    Raises FileNotFoundError where there is none, so that the caller can say how to get one, else InputError: for a
    folder, pipe, device or socket, for more bytes, and for what cannot be opened.
    """
    try:
        if folder is not None and not path.resolve().is_relative_to(folder.resolve()):
            raise InputError(f"{shown(path)}: leads out of {shown(folder)}; put the file itself there")
        number = os.open(path, _FLAGS)
    except FileNotFoundError:
        raise
    except OSError as error:
        raise InputError(f"{shown(path)}: {_reason(error)}") from None
    # A lone surrogate, a zero byte, or links in a circle.
    except (ValueError, RuntimeError) as error:
        raise InputError(f"{shown(path)}: no file can be called that ({error})") from None
    try:
        found = os.fstat(number)
        if not stat.S_ISREG(found.st_mode):
            raise InputError(f"{shown(path)}: is {_kind(found.st_mode)}, not a file; name a regular file")
        if found.st_size > most:
            raise InputError(f"{shown(path)}: larger than {_size(most)}, so it is no {what}")
        if hasattr(os, "set_blocking"):
            os.set_blocking(number, True)
        return io.BufferedReader(io.FileIO(number, "rb"))
    except BaseException:
        os.close(number)
        raise


@contextlib.contextmanager
def same_file(path: Path, most: int, *, folder: Path | None = None) -> Iterator[Callable[[], bool]]:
    """Yield a function that returns whether ``path`` still names the same file, whatever its content.

    The file is held open, so that its number in the file system is not given to another one; modification times, which
    depend on the clock, are not compared. On Windows an open file cannot be replaced. Raises as ``open_file`` does.
    """
    with open_file(path, most, folder=folder) as held:

        def is_same() -> bool:
            try:
                return os.path.samestat(os.fstat(held.fileno()), path.stat())
            except OSError:
                return False

        yield is_same


def read_bytes(path: Path, most: int, *, what: str = OF_PHYSGEN, folder: Path | None = None) -> bytes:
    """Return the content of the regular file ``path``, of at most ``most`` bytes. Raises as ``open_file`` does."""
    with open_file(path, most, what=what, folder=folder) as stream:
        try:
            content = stream.read(most + 1)
        except OSError as error:
            raise InputError(f"{shown(path)}: {_reason(error)}") from None
        except MemoryError:
            raise InputError(f"{shown(path)}: does not fit in memory; close other programs") from None
    # Files that grow meanwhile, and those of /proc, are longer than they say.
    if len(content) > most:
        raise InputError(f"{shown(path)}: larger than {_size(most)}, so it is no {what}")
    return content


def read_text(path: Path, most: int, *, what: str = OF_PHYSGEN, folder: Path | None = None) -> str:
    """Return the UTF-8 text of the file ``path``. Raises as ``read_bytes`` does, and InputError for other text."""
    try:
        return read_bytes(path, most, what=what, folder=folder).decode("utf-8")
    except UnicodeDecodeError as error:
        raise InputError(f"{shown(path)}: not readable as UTF-8 ({error}); save it as UTF-8") from None


def read_toml(path: Path, most: int, *, what: str = "TOML file") -> dict[str, Any]:
    """Return the content of the TOML file ``path``. Raises as ``read_text`` does, and InputError for other text."""
    text = read_text(path, most, what=what)
    try:
        return tomllib.loads(text)
    except (ValueError, RecursionError) as error:
        raise InputError(f"{shown(path)}: not readable as TOML ({error})") from None


def require_file(path: Path, most: int, *, what: str = OF_PHYSGEN) -> None:
    """Raise as ``open_file`` does, for libraries that open ``path`` themselves, by its name."""
    open_file(path, most, what=what).close()


def name_for_ffmpeg(path: Path) -> str:
    """Return the name by which OpenCV's FFmpeg opens the video ``path``, which it then does within our bounds: the file
    alone, of a format in ``VIDEO_FORMATS``. Other options in ``VIDEO_VARIABLE`` stay.

    The name is absolute, as a relative one such as ``data:x/video`` would be taken for a protocol.
    """
    if not utf8(str(path)):
        # OpenCV 5.0 ends the whole process instead.
        raise InputError(f"{shown(path)}: {NOT_UTF8}")
    given = os.environ.get(VIDEO_VARIABLE, "")
    if not given.endswith(_VIDEO_BOUNDS):
        os.environ[VIDEO_VARIABLE] = f"{given}|{_VIDEO_BOUNDS}" if given else _VIDEO_BOUNDS
    return str(path.absolute())


_SYNC_FLAGS = os.O_RDWR if os.name == "nt" else _FLAGS
"""Windows writes out only what was opened for writing."""


def to_disk(path: Path) -> None:
    """Wait until the content of the file or folder ``path`` is on the disk, so that a rename after it can count.

    Does nothing where the system cannot do it, such as for folders on Windows. Raises OSError for a full or failing
    disk.
    """
    try:
        number = os.open(path, _SYNC_FLAGS)
    except OSError:
        return
    try:
        os.fsync(number)
    except OSError as error:
        # Network file systems refuse with EINVAL; a full or failing disk does not.
        if error.errno not in (errno.EINVAL, errno.EROFS, errno.EBADF):
            raise
    finally:
        os.close(number)


NOT_UTF8 = "the name is no UTF-8, which the libraries that write pictures and videos need; rename it"


def utf8(name: str) -> bool:
    """Return whether ``name``, of a file as Python gives it, is UTF-8 and not other bytes."""
    try:
        name.encode()
    except UnicodeEncodeError:
        return False
    return True


def is_file(path: Path) -> bool:
    """Return whether ``path`` is a regular file that can be looked at; never raises."""
    try:
        return stat.S_ISREG(path.stat().st_mode)
    except (OSError, ValueError):
        return False


def shown(path: Path | str) -> str:
    """Return ``path`` for a message: at most 200 characters, printable, so that no name forges another line."""
    text = "".join(c if c.isprintable() else "\N{REPLACEMENT CHARACTER}" for c in str(path))
    return text if len(text) <= 200 else f"{text[:100]}…{text[-60:]}"


def without_folder(error: Exception, folder: Path) -> str:
    """Return the message of ``error`` with the files of ``folder`` named alone: for pages that are passed on, which
    shall not tell where they lay."""
    return str(error).replace(f"{shown(folder)}/", "").replace(f"{folder}/", "")


def _reason(error: OSError) -> str:
    if error.errno == errno.ENAMETOOLONG:
        return "the name is too long for a file; choose a shorter one"
    return str(error.strerror or error)


def _kind(mode: int) -> str:
    kinds = ((stat.S_ISDIR, "a folder"), (stat.S_ISFIFO, "a pipe"), (stat.S_ISSOCK, "a socket"))
    return next((name for test, name in kinds if test(mode)), "a device")


def _size(most: int) -> str:
    return f"{most >> 20} MiB" if most >= 2**20 else f"{most >> 10} KiB" if most >= 2**10 else f"{most} bytes"
