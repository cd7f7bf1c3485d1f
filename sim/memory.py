# SPDX-License-Identifier: MIT
"""Memory: what a stage will take, what there is, and how its lack shows. Imports nothing heavy.

The figures of a stage are its largest process's peak resident memory, measured at two sizes and checked at a third
(docs/measurements.md); those of a bake are in ``sim/mpm/cost_estimate.py``.
"""

from __future__ import annotations

import contextlib
import ctypes
import os
import sys
from collections.abc import Iterator
from pathlib import Path

from .errors import ANYWAY, InputError

MIB = 2**20


RECONSTRUCTION_BASE = 249 * MIB
RECONSTRUCTION_OBJECT = 17 * MIB
RECONSTRUCTION_BOX_PIXEL = 1340
"""Of a pixel in the boxes of all objects: masks, edges, bodies, textures. The rest of the photo, inpainted in pieces,
was below what the measurements tell apart."""
RECONSTRUCTION_RESERVED = 1300 * MIB

DECODED_BYTES = 20
"""Of a pixel of a photo as stored: decoded, turned upright, converted to sRGB. Measured: WebP 19, JPEG, PNG and TIFF 10
to 12."""


def reconstruction_bytes(box_pixels: int, objects: int) -> int:
    """Return the bytes that a reconstruction takes. box_pixels: working pixels in the boxes of all ``objects``."""
    return RECONSTRUCTION_BASE + RECONSTRUCTION_OBJECT * objects + RECONSTRUCTION_BOX_PIXEL * box_pixels


ENGINE_RESERVED = 1100 * MIB
"""Of a bake: Taichi begins with a pool of 1 GiB."""

COMPOSITION_BASE = 326 * MIB
COMPOSITION_CELL = 7000
"""Of a cell of the cube around the deformable object; of a ball, half of them hold particles."""
COMPOSITION_VERTEX = 7900
COMPOSITION_SPLAT = 1400
COMPOSITION_PIXEL = 60
"""Of the compared image, by the rasteriser's own account (``MAX_PIXELS``)."""
COMPOSITION_RESERVED = 2500 * MIB


def composition_bytes(cells: int, splats: int, vertices: int, pixels: int) -> int:
    """Return the bytes that a composition takes.

    cells: along the deformable object's longest side; splats: of all objects; vertices: of the largest mesh; pixels: of
    the compared image, 0 without one.
    """
    return (
        COMPOSITION_BASE
        + COMPOSITION_CELL * cells**3
        + COMPOSITION_SPLAT * splats
        + COMPOSITION_VERTEX * vertices
        + COMPOSITION_PIXEL * pixels
    )


RENDERING_BASE = 482 * MIB
RENDERING_PIXEL = 441
"""Of frames that objects fill; where they are small, less is rendered, and two thirds of it were taken."""
RENDERING_VERTEX = 1250
RENDERING_TEXEL = 32
"""Of a pixel of the objects' textures while the scene is built, before there are frames: decoded, written, and read by
Blender. Of 16 million in one texture or four, and of 4 million in one; of more, or in smaller ones, 20 to 25."""
RENDERING_RESERVED = 2300 * MIB


def rendering_bytes(pixels: int, vertices: int, texels: int = 0) -> int:
    """Return the bytes that rendering frames of ``pixels`` takes.

    vertices: of all objects and particles shown; texels: pixels of all textures.
    """
    most = max(RENDERING_PIXEL * pixels, RENDERING_TEXEL * texels)
    return RENDERING_BASE + RENDERING_VERTEX * vertices + most


def require_memory(needed: int, available: int | None, *, what: str, remedy: str) -> None:
    """Raise InputError when ``needed`` bytes are more than ``available``; None: not known, so never.

    Nor where the user gave ``--anyway`` (``ANYWAY``). what: that takes them; remedy: what to do about it, a clause.
    """
    if available is not None and needed > available and not os.environ.get(ANYWAY):
        raise InputError(
            f"this would take about {needed / 2**30:.3g} GiB of memory for {what}, and {available / 2**30:.3g} GiB are "
            f"available: {remedy}, or close other programs; --anyway tries it"
        )


LACK = (
    "out of memory",
    "bad_alloc",
    "cannot allocate",
    "failed to allocate",
    "insufficient memory",
    "unable to allocate",
    "failed to map segment",
    "can't start new thread",
    "mmap",
    "memory allocation",
)
"""Words by which libraries say that memory ran out: C++, OpenCV, NumPy, the dynamic linker, Python, Taichi."""


def ran_out(error: BaseException) -> bool:
    """Return whether ``error`` says that memory ran out, by whatever name."""
    return isinstance(error, MemoryError) or any(words in str(error).lower() for words in LACK)


def memory_kills(vmstat: Path = Path("/proc/vmstat")) -> int | None:
    """Return how many processes the kernel has killed for lack of memory since it started, in all control groups; None
    where the system does not say (all but Linux).
    """
    with contextlib.suppress(OSError, ValueError):
        for line in vmstat.read_text().splitlines():
            if line.startswith("oom_kill "):
                return int(line.split()[1])
    return None


def how_it_was_killed(kills_before: int | None) -> str:
    """Return what to say of a process that SIGKILL has ended, which cannot say it itself: a clause.

    kills_before: ``memory_kills`` when it began. Another process that the kernel has killed meanwhile counts as this.
    """
    now, left = memory_kills(), available_memory()
    free = "" if left is None else f"; {left / MIB:,.0f} MiB are available now"
    if None not in (kills_before, now) and now != kills_before:
        return f"it was killed by the system, as memory ran out{free}"
    return f"it was killed, possibly because memory ran out{free}"


def resident_memory() -> int | None:
    """Return the bytes of main memory that this process holds (macOS: held at most); None where that is not known."""
    try:
        if sys.platform.startswith("linux"):
            return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")
        if sys.platform == "darwin":
            import resource

            return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    except (OSError, ValueError, IndexError):
        pass
    return None


def return_freed_memory() -> None:
    """Give the system back what this process has freed: the C library of Linux keeps it in pieces between what is still
    in use, after large temporary arrays a third of all. Does nothing elsewhere."""
    if sys.platform.startswith("linux"):
        with contextlib.suppress(OSError, AttributeError):  # another C library
            ctypes.CDLL(None).malloc_trim(0)


_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD = -1, -3
"""Parameters of glibc's mallopt."""
KEPT_BYTES = 512 * MIB
"""Most freed memory at its end that a process keeps, and largest block that is taken from there."""
USUAL_BYTES = 64 * MIB, 32 * MIB
"""The same two as glibc raises them to in a process that frees large blocks."""


@contextlib.contextmanager
def freed_memory_kept() -> Iterator[None]:
    """Keep what this process frees for what it takes next, and give all of it back at the end.

    The C library of Linux returns large blocks at once, and every temporary picture takes fresh pages, which the system
    has to clear: a tenth of a reconstruction. Does nothing elsewhere.
    """
    mallopt = None
    if sys.platform.startswith("linux"):
        with contextlib.suppress(OSError, AttributeError):  # another C library
            mallopt = ctypes.CDLL(None).mallopt
    if mallopt is None:
        yield
        return
    for limit in (_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD):
        mallopt(limit, KEPT_BYTES)
    try:
        yield
    finally:
        for limit, usual in zip((_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD), USUAL_BYTES, strict=True):
            mallopt(limit, usual)
        return_freed_memory()


def available_memory(reserved: int = 0) -> int | None:
    """Return the bytes of main memory that this process may still take without swapping; None where that is not known.

    Linux: the least of MemAvailable, what the control groups leave, and what the limit on this process's address space
    (``ulimit -v``) leaves less ``reserved``: bytes of addresses that the stage maps and does not use, for libraries and
    the stacks of threads. Windows: available physical memory. Elsewhere (macOS): half of all physical memory, since
    free memory means little there.
    """
    try:
        if sys.platform == "win32":
            return _windows_memory()
        if sys.platform.startswith("linux"):
            found = [_linux_memory(Path("/proc/meminfo")), _group_memory(Path("/proc/self/cgroup"))]
            left = _address_space_left()
            found.append(None if left is None else max(0, left - reserved))
            return min((bytes_ for bytes_ in found if bytes_ is not None), default=None)
        return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE") // 2
    except (OSError, ValueError, AttributeError):
        return None


def _linux_memory(meminfo: Path) -> int | None:
    for line in meminfo.read_text().splitlines():
        if line.startswith("MemAvailable:"):
            return int(line.split()[1]) * 1024
    return None


def _group_memory(membership: Path, root: Path = Path("/sys/fs/cgroup")) -> int | None:
    """Return the bytes that the control groups of this process leave; None without a limit.

    A group's limit holds for all below it. Inside a container the path that ``membership`` names may not be there: then
    ``root`` is this group. Files in the page cache are given back when memory is short, so they do not count as taken.
    """
    left: list[int] = []
    try:
        lines = membership.read_text().splitlines()
    except OSError:
        return None
    for line in lines:
        _, _, rest = line.partition(":")
        controllers, _, path = rest.partition(":")
        if controllers == "":
            base, names = root, ("memory.max", "memory.current", "inactive_file")
        elif "memory" in controllers.split(","):
            base, names = root / "memory", ("memory.limit_in_bytes", "memory.usage_in_bytes", "total_inactive_file")
        else:
            continue
        parts = [part for part in path.split("/") if part not in ("", "..")]
        for depth in range(len(parts) + 1):
            found = _left_in(base.joinpath(*parts[:depth]), *names)
            if found is not None:
                left.append(found)
    return min(left, default=None)


def _left_in(group: Path, limit_file: str, used_file: str, cached: str) -> int | None:
    try:
        limit = (group / limit_file).read_text().strip()
        # Without one: "max", or in the first version the largest multiple of a page.
        if limit == "max" or int(limit) >= 2**60:
            return None
        used = int((group / used_file).read_text())
        stat = dict(line.split() for line in (group / "memory.stat").read_text().splitlines())
        return max(0, int(limit) - used + int(stat.get(cached, 0)))
    except (OSError, ValueError):
        return None


def _address_space_left() -> int | None:
    """Return the bytes that ``ulimit -v`` leaves this process, and those that it starts; None without a limit."""
    import resource

    most, _ = resource.getrlimit(resource.RLIMIT_AS)
    if most == resource.RLIM_INFINITY:
        return None
    used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    return max(0, most - used)


def _windows_memory() -> int | None:
    class Status(ctypes.Structure):
        _fields_ = (
            ("length", ctypes.c_ulong),
            ("load", ctypes.c_ulong),
            *((name, ctypes.c_ulonglong) for name in ("total", "available", "a", "b", "c", "d", "e")),
        )

    status = Status()
    status.length = ctypes.sizeof(status)
    good = ctypes.windll.kernel32.GlobalMemoryStatusEx(ctypes.byref(status))  # type: ignore[attr-defined]
    return int(status.available) if good else None
