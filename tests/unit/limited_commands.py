# SPDX-License-Identifier: MIT
"""Commands under limits: ``python limited_commands.py FOLDER`` prints what each of them did, as lines of JSON.

Libraries are imported and inputs drawn once; then every command runs in a fork of its own, in a folder without its
result and in one that has it, under each limit. A line has the command, the limit, whether its result was there, its
exit code, what it said, and how the folder differs from that of an undisturbed run and from what it was.
"""

from __future__ import annotations

import json
import os
import resource
import shutil
import signal
import sys
import tempfile
import traceback
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
from physgen.batch import cli
from physgen.benchmarks.kill_chain import draw_inputs
from physgen.benchmarks.kills import contents
from physgen.sim.cache.bake_folder import BakedObject, BakeManifest, save_manifest
from physgen.sim.cache.pc2 import Pc2Writer
from physgen.sim.version import VERSION

COMMANDS = {
    "variant": "variant pair --preset jelly --out windy",
    "light": "light pair --sun-direction 0.5,0.3,1 --sun-strength 2",
    "capture": "capture import table.csv --diameter 0.1 --mass 0.1 --out captured",
    "questionnaire": "questionnaire case --out asked",
    "collect": "questionnaire answers.json --collect --key key.json --out results",
    "pack": "pack whole --out packed",
    "unpack": "pack packed --unpack --out unpacked",
    "export": "export pair --bake whole --usd moving.usda",
}
NEEDS = {"unpack": "pack"}


def no_more_than(limit: int, most: int) -> None:
    """Set a limit of this process."""
    resource.setrlimit(limit, (most, resource.getrlimit(limit)[1]))


def limit(name: str, folder: Path) -> None:
    """Put this process under the limit ``name``."""
    kind, _, number = name.partition(" ")
    if kind == "bytes":
        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        no_more_than(resource.RLIMIT_FSIZE, int(number))
    elif kind == "files":
        no_more_than(resource.RLIMIT_NOFILE, int(number))
    elif kind == "memory":
        used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
        no_more_than(resource.RLIMIT_AS, used + (int(number) << 20))
    elif kind == "temporary":
        for variable in ("TMPDIR", "TEMP", "TMP"):
            os.environ[variable] = str(folder.parent / "log")
        tempfile.tempdir = None
    elif kind == "home":
        del os.environ["PHYSGEN_CONFIG"]
        os.environ |= {"HOME": str(folder.parent / "log"), "XDG_CONFIG_HOME": str(folder.parent / "log")}


LIMITS = ("bytes 0", "bytes 600", "bytes 6000", "files 16", "memory 24", "temporary", "home")
AGAIN = ("bytes 600", "memory 24")
"""Where the result is there already."""


def run(words: str, name: str, folder: Path) -> tuple[int, str]:
    """Run the command in ``folder`` under the limit; return its exit code and what it said."""
    log = folder.parent / "log"
    # Opened before the limit on files, and not written under that on bytes.
    read, write = os.pipe()
    sys.stdout.flush()
    if (pid := os.fork()) == 0:
        code = 70
        try:
            log.touch()
            for number in (1, 2):
                os.dup2(write, number)
            sys.stdout, sys.stderr = os.fdopen(1, "w", closefd=False), os.fdopen(2, "w", 1, closefd=False)
            os.chdir(folder)
            os.environ["PHYSGEN_CONFIG"] = str(folder / ".config")
            os.environ["TMPDIR"] = str(folder.parent / "scratch")
            tempfile.tempdir = None
            limit(name, folder)
            code = cli.main(words.split())
        except SystemExit as end:
            code = end.code if isinstance(end.code, int) else 1
        except BaseException:
            traceback.print_exc()
        finally:
            sys.stdout.flush()
            sys.stderr.flush()
            os._exit(code)
    os.close(write)
    with os.fdopen(read, "rb") as pipe:
        said = pipe.read().decode(errors="replace")
    return os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]), said


def draw(folder: Path, *, frames: int = 2) -> None:
    """Write the inputs of all commands, of ``frames`` baked frames, into ``folder``."""
    folder.mkdir()
    draw_inputs(folder)
    (folder / "whole").mkdir()
    points = np.random.default_rng(0).random((frames, 162, 3))
    items = []
    for name in "ab":
        with Pc2Writer(folder / "whole" / f"{name}.pc2", vertex_count=162, start_frame=1) as cache:
            for sample in points:
                cache.append(sample)
        items.append(BakedObject(name=name, file=f"{name}.pc2", vertices=162))
    numbers = {"inputs_hash": "0" * 64, "fps": 24.0, "frame_start": 1, "particles": 324}
    numbers |= {"frames": frames, "frames_done": frames}
    manifest = BakeManifest(**numbers, state="complete", engine="mpm", version=VERSION, objects=tuple(items))
    save_manifest(folder / "whole", manifest)


def main(root: Path) -> None:
    """Run all commands under all limits."""
    draw(root / "start")
    work = root / "work"
    (root / "scratch").mkdir()

    def begin(state: str) -> None:
        shutil.rmtree(work, ignore_errors=True)
        shutil.copytree(root / state, work, symlinks=True)

    for command, words in COMMANDS.items():
        state = f"after {NEEDS[command]}" if command in NEEDS else "start"
        begin(state)
        code, said = run(words, "none", work)
        assert code == 0, (command, said)
        whole = contents(work)
        shutil.copytree(work, root / f"after {command}", symlinks=True)
        for there in (False, True):
            before = root / (f"after {command}" if there else state)
            earlier = contents(before)
            for name in AGAIN if there else LIMITS:
                begin(before.name)
                code, said = run(words, name, work)
                found = contents(work)
                line: dict[str, object] = {
                    "command": command,
                    "limit": name,
                    "there": there,
                    "code": code,
                    "said": said,
                }
                line["differs"] = {
                    kind: sorted(key for key in found.keys() | other.keys() if found.get(key) != other.get(key))
                    for kind, other in (("earlier", earlier), ("whole", whole))
                }
                line["scratch"] = sorted(path.name for path in (root / "scratch").iterdir())
                sys.stdout.write(json.dumps(line) + "\n")
                sys.stdout.flush()


if __name__ == "__main__":
    main(Path(sys.argv[1]))
