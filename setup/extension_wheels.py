# SPDX-License-Identifier: GPL-3.0-or-later
"""The wheels of an extension, as the package index has them: which, and downloaded once."""

from __future__ import annotations

import hashlib
import json
import re
import shutil
import subprocess
import sys
import tempfile
import tomllib
from dataclasses import dataclass
from pathlib import Path

SHIPPED = frozenset(
    {
        "numpy",
        "requests",
        "urllib3",
        "certifi",
        "idna",
        "charset-normalizer",
        "zstandard",
        "cattrs",
        "attrs",
        "typing-extensions",
        "cython",
        "setuptools",
        "pip",
    }
)
"""What every Blender brings along; a second copy could only disagree with it."""
PURE = ("trimesh",)
"""What Blender's own process uses besides numpy: it reads mesh files."""


@dataclass(frozen=True, kw_only=True)
class Target:
    """Where wheels have to run. python: ``3.13``; platforms: wheel tags, best first; numpy: the one that is there."""

    python: str
    platforms: tuple[str, ...]
    numpy: str


def requirements(root: Path, python: str) -> list[str]:
    """What the project at ``root`` depends on with that Python, markers resolved (pip would ask its own Python)."""
    project = tomllib.loads((root / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    found = []
    for line in project["dependencies"]:
        wanted, _, marker = line.partition(";")
        if not marker or _holds(marker.strip(), python):
            found.append(wanted.strip())
    return found


def _holds(marker: str, python: str) -> bool:
    found = re.fullmatch(r"python_version\s*(<|>=)\s*'([\d.]+)'", marker)
    if found is None:
        raise ValueError(f"pyproject.toml: marker {marker!r}: only python_version < and >= are understood here")
    have, least = ([int(n) for n in text.split(".")] for text in (python, found[2]))
    return have >= least if found[1] == ">=" else have < least


def all_wheels(root: Path, target: Target, cache: Path) -> list[Path]:
    """Wheels of everything the project needs on ``target`` and Blender does not ship, sorted by name."""
    wanted = [*requirements(root, target.python), target.numpy]
    return _cached(wanted, target, cache)


def pure_wheels(root: Path, cache: Path) -> list[Path]:
    """Wheels of ``PURE``, for any Python on any platform."""
    wanted = [line for line in requirements(root, "3.13") if re.split("[<>=]", line)[0] in PURE]
    return _cached(wanted, None, cache)


def _cached(wanted: list[str], target: Target | None, cache: Path) -> list[Path]:
    """The wheels of ``wanted``, from a folder of ``cache`` that is named after the question."""
    key = hashlib.sha256(json.dumps([wanted, str(target), sorted(SHIPPED)]).encode()).hexdigest()[:12]
    folder = cache / (f"{target.platforms[-1]}-{target.python}-{key}" if target else f"any-{key}")
    if not folder.is_dir():
        cache.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=cache) as temporary:
            partial = Path(temporary) / "wheels"
            _download(_resolved(wanted, target), target, partial)
            shutil.move(partial, folder)
    return sorted(folder.glob("*.whl"))


def _flags(target: Target | None) -> list[str]:
    if target is None:
        return ["--only-binary=:all:"]
    platforms = [flag for name in target.platforms for flag in ("--platform", name)]
    return ["--only-binary=:all:", "--python-version", target.python, "--implementation", "cp", *platforms]


def _resolved(wanted: list[str], target: Target | None) -> list[str]:
    """``NAME==VERSION`` of all that ``wanted`` needs and Blender does not ship; just ``wanted`` for any Python."""
    if target is None:
        return wanted
    options = ["--dry-run", "--ignore-installed", "--quiet", "--report", "-", "--target", "unused"]
    report = json.loads(_pip("install", *options, *_flags(target), *wanted))
    found = [item["metadata"] for item in report["install"]]
    return sorted(f"{item['name']}=={item['version']}" for item in found if _plain(item["name"]) not in SHIPPED)


def _plain(name: str) -> str:
    return re.sub(r"[-_.]+", "-", name).lower()


def _download(pinned: list[str], target: Target | None, folder: Path) -> None:
    _pip("download", "--no-deps", "--quiet", "--dest", str(folder), *_flags(target), *pinned)


def _pip(*arguments: str) -> str:
    command = [sys.executable, "-m", "pip", "--disable-pip-version-check", *arguments]
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout
