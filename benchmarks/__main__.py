# SPDX-License-Identifier: GPL-3.0-or-later
"""List the benchmarks, or run some of them one after the other.

    python -m physgen.benchmarks                       list them
    python -m physgen.benchmarks mpm worlds [--quick]  run these
    python -m physgen.benchmarks all --quick           run all

Options of a single benchmark: ``python -m physgen.benchmarks.NAME --help``.
"""

from __future__ import annotations

import argparse
import ast
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path

HERE = Path(__file__).parent
NEEDS_INPUT = ("diagnosis", "first_frame", "published", "rest")
"""Benchmarks of the user's own files; ``--quick`` makes some."""


def benchmarks() -> dict[str, str]:
    """Return the first line of each benchmark's docstring by name. Imports none of them: some need bpy."""
    found = {}
    for path in sorted(HERE.glob("*.py")):
        if path.stem not in ("__init__", "__main__", "common", "kill_chain", "newton_run"):
            text = ast.get_docstring(ast.parse(path.read_text(encoding="utf-8"))) or ""
            found[path.stem] = text.splitlines()[0]
    return found


def main(arguments: Sequence[str] | None = None) -> int:
    """Entry point; returns 0 if all benchmarks ended with 0."""
    known = benchmarks()
    parser = argparse.ArgumentParser(
        prog="python -m physgen.benchmarks", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"all, or some of {', '.join(known)}")
    parser.add_argument("--quick", action="store_true", help="seconds each: checks that they run, measures nothing")
    options = parser.parse_args(arguments)
    if not options.names:
        print("\n".join(f"{name:<12} {text}" for name, text in known.items()))
        return 0
    names = options.names
    if names == ["all"]:
        names = [name for name in known if options.quick or name not in NEEDS_INPUT]
    for name in names:
        if name not in known:
            parser.error(f"unknown benchmark {name!r}: choose all, or some of {', '.join(known)}")
    failed = []
    for name in names:
        print(f"==== {name}: {known[name]}", flush=True)
        started = time.monotonic()
        command = [sys.executable, "-m", f"physgen.benchmarks.{name}", *(["--quick"] if options.quick else [])]
        code = subprocess.run(command).returncode
        print(f"==== {name}: {'done' if code == 0 else f'exit code {code}'} in {time.monotonic() - started:.0f} s\n")
        if code != 0:
            failed.append(name)
    if failed:
        print(f"failed: {', '.join(failed)}", file=sys.stderr)
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
