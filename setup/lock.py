# SPDX-License-Identifier: GPL-3.0-or-later
"""Writes the lock file of this interpreter and platform: every package that `make setup` installs, with its hash.

    python setup/lock.py            the newest versions that pyproject.toml allows
    python setup/lock.py --installed    the versions that are installed here: what was tested
    python setup/lock.py --name     the name of this interpreter's lock file, whether it is there or not

pip resolves without installing; the hashes are those that the package index states for the very files it chose. The
lock names no index: whichever pip is configured for, a file with another hash is refused.
"""

from __future__ import annotations

import argparse
import importlib.metadata
import json
import re
import subprocess
import sys
import sysconfig
from pathlib import Path

from pip._vendor.packaging.requirements import Requirement

ROOT = Path(__file__).resolve().parents[1]
LOCKS = ROOT / "setup" / "locks"
HEAD = "# Made by `make lock`; `make setup` installs exactly these. docs/security.md says how to update it.\n"


def lock_name() -> str:
    """Return the name of the lock file for the running interpreter, such as ``linux-x86_64-py313.txt``."""
    major, minor = sys.version_info[:2]
    return f"{re.sub(r'[^a-z0-9_]+', '-', sysconfig.get_platform().lower())}-py{major}{minor}.txt"


def resolved(extras: str) -> list[tuple[str, str, str]]:
    """Return name, version and SHA-256 of every package that the project with ``extras`` needs, sorted."""
    return _report([f"{ROOT}[{extras}]"])


def _report(wanted: list[str]) -> list[tuple[str, str, str]]:
    command = [sys.executable, "-m", "pip", "install", "--dry-run", "--ignore-installed", "--quiet", "--report", "-"]
    done = subprocess.run(
        [*command, "--disable-pip-version-check", *wanted], stdout=subprocess.PIPE, text=True, check=True
    )
    found = []
    for item in json.loads(done.stdout)["install"]:
        name, version = item["metadata"]["name"], item["metadata"]["version"]
        if name.lower() == "physgen":
            continue
        found.append(
            (re.sub(r"[-_.]+", "-", name).lower(), version, item["download_info"]["archive_info"]["hashes"]["sha256"])
        )
    return sorted(found)


def installed(extras: str) -> list[tuple[str, str, str]]:
    """Return the same of what is installed in this environment, so that what was tested is what is locked."""
    waiting, pins = [f"physgen[{extras}]"], dict[str, str]()
    seen: set[str] = set()
    while waiting:
        wanted = Requirement(waiting.pop())
        if str(wanted) in seen:
            continue
        seen.add(str(wanted))
        found = importlib.metadata.distribution(wanted.name)
        name = re.sub(r"[-_.]+", "-", wanted.name).lower()
        if name != "physgen":
            pins[name] = found.version
        for text in found.requires or ():
            needed = Requirement(text)
            marks = (
                [needed.marker.evaluate({"extra": extra}) for extra in ("", *wanted.extras)]
                if needed.marker
                else [True]
            )
            if any(marks):
                waiting.append(f"{needed.name}[{','.join(needed.extras)}]" if needed.extras else needed.name)
    return _report(["--no-deps", *(f"{name}=={version}" for name, version in sorted(pins.items()))])


def main() -> int:
    """Write the lock file, or print its name."""
    parser = argparse.ArgumentParser(description="lock what `make setup` installs")
    parser.add_argument("--name", action="store_true", help="print the name of this interpreter's lock file")
    parser.add_argument("--installed", action="store_true", help="lock the versions that are installed here")
    parser.add_argument("--extras", default="blender,dev")
    options = parser.parse_args()
    path = LOCKS / lock_name()
    if options.name:
        print(path.relative_to(ROOT).as_posix())  # noqa: T201
        return 0
    packages = (installed if options.installed else resolved)(options.extras)
    lines = [f"{name}=={version} --hash=sha256:{digest}\n" for name, version, digest in packages]
    LOCKS.mkdir(exist_ok=True)
    path.write_text(HEAD + "".join(lines), encoding="utf-8")
    print(f"{path.relative_to(ROOT)}: {len(lines)} packages")  # noqa: T201
    return 0


if __name__ == "__main__":
    sys.exit(main())
