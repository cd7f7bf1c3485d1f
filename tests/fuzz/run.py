# SPDX-License-Identifier: MIT
"""Reads damaged files with every loader: only PhysGenError may escape, within seconds and a bounded address space.
No loader may start a program, call anybody, or write, rename or remove anything outside its temporary folders.

    python tests/fuzz/run.py --count 300                     every loader, 300 inputs each
    python tests/fuzz/run.py --only "mesh OBJ" --index 17    one input again, with its traceback

Every loader runs in a child of its own, so that a crash of the interpreter is a result like any other. Input I of a
loader follows from its name, the seed and I alone.
"""

from __future__ import annotations

import argparse
import contextlib
import functools
import json
import math
import mmap
import os
import random
import resource
import select
import shutil
import signal
import struct
import sys
import tempfile
import time
import traceback
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from types import FrameType
from typing import Any

sys.path.insert(0, str(Path(__file__).parent))

import loaders_bakes  # noqa: F401 - each adds its loaders
import loaders_captures  # noqa: F401
import loaders_evaluate  # noqa: F401
import loaders_jobs  # noqa: F401
import loaders_pictures  # noqa: F401
import loaders_scenes  # noqa: F401
from hostile import INSTEAD
from loaders import LOADERS, Loader
from mutations import mutated
from physgen.sim.errors import PhysGenError
from physgen.sim.importers import recorded_files

CPU_S, WALL_S = 5.0, 20.0
"""Longest that one input may compute, and be waited for on a busy machine."""
ADDRESS_SPACE = 3 * 2**29
"""Bytes beyond those of the process with all libraries loaded, before it reads anything."""
MOST_CRASHES = 5


class TooSlow(BaseException):
    """An input took longer than ``CPU_S``; no loader catches it."""


class Forbidden(BaseException):
    """A loader did what none may: started a program, called somebody, or changed a file elsewhere."""


RUNS = ("subprocess.Popen", "os.system", "os.exec", "os.spawn", "os.posix_spawn", "os.fork", "os.forkpty", "pty.spawn")
OWN_READER = [sys.executable, "-I", str(recorded_files._WORKER)]
"""The process in which native readers run: started for every recording, whatever is in it; not watched itself."""
CALLS = ("socket.connect", "socket.bind", "socket.getaddrinfo", "socket.gethostbyname", "urllib.Request")
CHANGES = ("os.rename", "os.remove", "os.mkdir", "os.rmdir", "os.link", "os.symlink", "os.truncate", "os.chmod")


@functools.cache
def _real_places(*places: str) -> tuple[str, ...]:
    return tuple(os.path.realpath(place) for place in places)


class Guard:
    """Python's audit events of what no loader may do, while one reads. Hooks cannot be removed, so it is one object."""

    def __init__(self) -> None:
        """Watch nothing yet."""
        self.places: tuple[str, ...] | None = None
        self.changed = False

    def see(self, event: str, given: tuple[Any, ...]) -> None:
        """Raise Forbidden for such an event."""
        if self.places is None:
            return
        if event == "subprocess.Popen" and list(given[1][:3]) == OWN_READER:
            return
        if event in RUNS or event in CALLS:
            raise Forbidden(f"{event} {str(given)[:100]}")
        if event == "open":
            _, mode, flags = (*given, None, None)[:3]
            writes = isinstance(flags, int) and flags & (os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC)
            if not (writes or (isinstance(mode, str) and set("wax+") & set(mode))):
                return
        elif event not in CHANGES:
            return
        count = 2 if event in ("os.rename", "os.link") else 1
        at = given[count:] if event in CHANGES else ()
        for index, path in enumerate(given[:count]):
            where = at[index] if index < len(at) and isinstance(at[index], int) else -1
            if isinstance(path, str | bytes) and not self._is_ours(os.fsdecode(path), where, follows=event == "open"):
                raise Forbidden(f"{event} {os.fsdecode(path)[:100]}")
        self.changed = True

    def _is_ours(self, path: str, where: int, *, follows: bool) -> bool:
        """Return whether ``path``, from the open folder ``where`` if that is none of -1, is in one of the places.

        follows: whether a link of that name is followed, too, and not only those of the folders that it is in.
        """
        assert self.places is not None
        path = os.path.join(f"/proc/self/fd/{where}" if where >= 0 else "", path)  # noqa: PTH118 - may be no name at all
        real = os.path.realpath(path)
        if not follows:
            real = os.path.join(os.path.realpath(os.path.dirname(path)), os.path.basename(path))  # noqa: PTH118, PTH119, PTH120
        return real == os.devnull or any(real.startswith(f"{place}{os.sep}") for place in self.places)

    @contextlib.contextmanager
    def watching(self, folder: Path) -> Iterator[None]:
        """Watch; ``folder`` and the temporary folder may be written to, after which ``changed`` is true."""
        self.places, self.changed = _real_places(str(folder), tempfile.gettempdir()), False
        try:
            yield
        finally:
            self.places = None


guard = Guard()


def chosen(loader: Loader, index: int) -> tuple[str, Callable[[Path], object] | None]:
    """Return which file input ``index`` is about, and what is put in its place; None: it is damaged.

    Every other input is one of ``INSTEAD`` until each file had them all.
    """
    number, files = index // 2, loader.files
    special = index % 2 == 0 and number < len(INSTEAD) * len(files)
    return files[number % len(files)], INSTEAD[number // len(files)] if special else None


def place_input(name: str, loader: Loader, folder: Path, seed: int, index: int, content: bytes) -> None:
    """Write over the file of ``loader`` in ``folder`` that input ``index`` is about. content: what it holds."""
    file, instead = chosen(loader, index)
    path = folder / file
    if instead is not None:
        path.unlink()
        instead(path)
        return
    choose = random.Random(f"{name}:{seed}:{index}")
    path.write_bytes(mutated(content, choose, as_json=path.suffix in (".json", ".gltf")))


@contextlib.contextmanager
def _bounded() -> Iterator[None]:
    """Bounds on time, for one input."""

    def stop(number: int, frame: FrameType | None) -> None:
        raise TooSlow(f"{'cpu' if number == signal.SIGPROF else 'wall'} time")

    signal.signal(signal.SIGPROF, stop)
    signal.signal(signal.SIGALRM, stop)
    signal.setitimer(signal.ITIMER_PROF, CPU_S)
    signal.setitimer(signal.ITIMER_REAL, WALL_S)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
        signal.setitimer(signal.ITIMER_REAL, 0)


class Inputs:
    """The files of a loader in ``folder``, one of them damaged at a time.

    Only that one is put back for the next input, which takes a tenth of the time of writing all of them: all are
    written anew where the loader changed any itself, and after every ``ANEW`` inputs whatever it did.
    """

    ANEW = 500

    def __init__(self, name: str, loader: Loader, template: Path, folder: Path, seed: int) -> None:
        """template: folder with the undamaged files, which stays as it is."""
        self.name, self.loader, self.template, self.folder, self.seed = name, loader, template, folder, seed
        self.contents = {file: (template / file).read_bytes() for file in loader.files}
        self.damaged, self.special = "", False
        self.used = self.ANEW

    def place(self, index: int) -> None:
        """Have the files undamaged but for the one that input ``index`` damages."""
        file, instead = chosen(self.loader, index)
        # What was no file may have brought another one with it.
        if self.used >= self.ANEW or self.special:
            shutil.rmtree(self.folder, ignore_errors=True)
            shutil.copytree(self.template, self.folder)
            self.used = 0
        elif self.damaged != file:
            (self.folder / self.damaged).write_bytes(self.contents[self.damaged])
        self.used += 1
        self.damaged, self.special = file, instead is not None
        place_input(self.name, self.loader, self.folder, self.seed, index, self.contents[file])

    def attempt(self, index: int) -> BaseException | None:
        """Return what escaped from the loader besides PhysGenError at input ``index``; None if nothing."""
        self.place(index)
        try:
            with _bounded(), guard.watching(self.folder):
                self.loader.read(self.folder)
        except PhysGenError as error:
            return None if str(error) else error
        except BaseException as error:
            return error
        finally:
            if guard.changed:
                self.used = self.ANEW
        return None


def _where(error: BaseException) -> str:
    """Return the type and the last own line of the traceback."""
    own = [f for f in traceback.extract_tb(error.__traceback__) if "/sim/" in f.filename or "physgen" in f.filename]
    own = [f for f in own if "/tests/" not in f.filename] or own
    place = f"{Path(own[-1].filename).name}:{own[-1].lineno}" if own else "?"
    return f"{type(error).__name__} at {place}: {str(error)[:160]}"


def _limit_memory() -> None:
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    most = pages * resource.getpagesize() + ADDRESS_SPACE
    resource.setrlimit(resource.RLIMIT_AS, (most, most))


def _child(name: str, loader: Loader, seed: int, first: int, count: int, at: mmap.mmap, out: int, cpu_s: float) -> None:
    """Run inputs ``first`` to ``count``: each finding is a line on ``out``, the number reached is in ``at``."""
    warnings.simplefilter("ignore")
    with open(os.devnull, "w") as nowhere:  # noqa: PTH123
        os.dup2(nowhere.fileno(), 2)
    with tempfile.TemporaryDirectory(prefix="physgen-fuzz-") as place:
        template, folder = Path(place, "template"), Path(place, "input")
        template.mkdir()
        try:
            loader.write(template)
            shutil.copytree(template, folder)
            loader.read(folder)
        except BaseException as error:
            os.write(out, f"{json.dumps([-1, 'as it is: ' + _where(error)])}\n".encode())
            return
        inputs = Inputs(name, loader, template, folder, seed)
        _limit_memory()
        sys.addaudithook(guard.see)
        for index in range(first, count):
            at[:8] = struct.pack("<q", index)
            if time.process_time() > cpu_s:
                return
            error = inputs.attempt(index)
            if error is not None:
                os.write(out, f"{json.dumps([index, _where(error)])}\n".encode())
        at[:8] = struct.pack("<q", count)


def fuzz(name: str, *, count: int, seed: int = 0, cpu_s: float = 1e9) -> tuple[int, list[tuple[int, str]]]:
    """Return how many inputs the loader ``name`` was given, and (index, text) of each that something escaped at."""
    found: list[tuple[int, str]] = []
    first, crashes = 0, 0
    while True:
        at = mmap.mmap(-1, 8)
        reading, writing = os.pipe()
        pid = os.fork()
        if pid == 0:
            code = 1
            try:
                os.close(reading)
                _child(name, LOADERS[name], seed, first, count, at, writing, time.process_time() + cpu_s)
                code = 0
            finally:
                os._exit(code)
        os.close(writing)
        status = _listen(pid, reading, found, at)
        (reached,) = struct.unpack("<q", at[:8])
        if status == 0:
            return reached, found
        crashes += 1
        found.append((reached, f"the process ended with {status}"))
        first = reached + 1
        if crashes > MOST_CRASHES or first >= count:
            return first, found


def _listen(pid: int, reading: int, found: list[tuple[int, str]], at: mmap.mmap) -> int:
    """Collect what a child reports; return how it ended, "stuck" where an input keeps it for too long."""
    content, before, since, stuck = b"", at[:8], time.monotonic(), False
    while True:
        ready, _, _ = select.select([reading], [], [], 2.0)
        if ready:
            piece = os.read(reading, 65536)
            if not piece:
                break
            content += piece
        if at[:8] != before:
            before, since = at[:8], time.monotonic()
        elif time.monotonic() - since > 1.5 * WALL_S:
            os.kill(pid, signal.SIGKILL)
            stuck = True
    os.close(reading)
    found += [tuple(json.loads(line)) for line in content.splitlines()]
    _, status = os.waitpid(pid, 0)
    return -1 if stuck else os.waitstatus_to_exitcode(status)


def again(name: str, seed: int, index: int) -> None:
    """Read one input, here, and let its traceback be seen."""
    loader = LOADERS[name]
    place = Path(tempfile.mkdtemp(prefix="physgen-fuzz-"))
    (place / "input").mkdir()
    loader.write(place / "input")
    if index >= 0:
        content = (place / "input" / chosen(loader, index)[0]).read_bytes()
        place_input(name, loader, place / "input", seed, index, content)
    print(f"{name}, seed {seed}, input {index}: {place / 'input'}")  # noqa: T201
    _limit_memory()
    sys.addaudithook(guard.see)
    with guard.watching(place / "input"):
        loader.read(place / "input")


def main() -> int:
    """Run the loaders that the command line names; return 1 where anything was found."""
    parser = argparse.ArgumentParser(description="read damaged files with every loader")
    parser.add_argument("--count", type=int, default=300, help="inputs for each loader, fewer for slow ones")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", nargs="*", default=list(LOADERS), choices=list(LOADERS), metavar="NAME")
    parser.add_argument("--index", type=int, help="this input of the one loader that --only names, with its traceback")
    parser.add_argument("--cpu", type=float, default=1e9, help="CPU seconds for each loader, at most")
    parser.add_argument("--json", action="store_true", help="the findings as JSON")
    options = parser.parse_args()
    if options.index is not None:
        again(options.only[0], options.seed, options.index)
        return 0
    results = {}
    for name in options.only:
        started = resource.getrusage(resource.RUSAGE_CHILDREN)
        count = math.ceil(options.count * LOADERS[name].share)
        done, found = fuzz(name, count=count, seed=options.seed, cpu_s=options.cpu)
        ended = resource.getrusage(resource.RUSAGE_CHILDREN)
        cpu = ended.ru_utime + ended.ru_stime - started.ru_utime - started.ru_stime
        results[name] = {"inputs": done, "asked": count, "cpu_s": round(cpu, 2), "found": found}
        if not options.json:
            kinds: dict[str, list[int]] = {}
            for index, text in found:
                kinds.setdefault(text, []).append(index)
            print(f"{name}: {done} inputs, {cpu:.1f} CPU s, {len(found)} escaped", flush=True)  # noqa: T201
            for text, indices in sorted(kinds.items(), key=lambda pair: -len(pair[1]))[:12]:
                print(f"    {len(indices)} × {text} (input {indices[0]})", flush=True)  # noqa: T201
    if options.json:
        print(json.dumps(results))  # noqa: T201
    return int(any(result["found"] for result in results.values()))


if __name__ == "__main__":
    sys.exit(main())
