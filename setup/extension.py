# SPDX-License-Identifier: GPL-3.0-or-later
"""``make extension``: the zips that Blender installs.

    python setup/extension.py [--zips NAME… | all] [--out dist] [--wheels build/wheels]

``any`` runs in every Blender from 4.5 and needs a Python of its own to simulate, named in the preferences; the others
hold all that simulates, for one platform and one line of Blender. Default: ``any`` and those for this platform. Only
what is not yet in the wheels' folder is downloaded.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import platform
import re
import shutil
import subprocess
import sys
import tempfile
import tomllib
import zipfile
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from fnmatch import fnmatch
from pathlib import Path
from typing import Any

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
"""Packages that every Blender ships; a second copy could only conflict with them."""
PURE = ("trimesh",)
"""Packages that Blender's own process uses besides numpy: trimesh reads mesh files."""


@dataclass(frozen=True, kw_only=True)
class Target:
    """Where wheels have to run. python: ``3.13``; platforms: wheel tags, best first; numpy: the one that is there."""

    python: str
    platforms: tuple[str, ...]
    numpy: str


MANIFEST = "blender_manifest.toml"
ROOT = Path(__file__).resolve().parents[1]

LINUX = (*(f"manylinux_2_{minor}_x86_64" for minor in (28, 27, 24, 17)), "manylinux2014_x86_64")
MAC = tuple(f"macosx_{major}_0_arm64" for major in (14, 13, 12, 11))
PLATFORMS = {"linux-x64": LINUX, "windows-x64": ("win_amd64",), "macos-arm64": MAC}
"""Blender's name of a platform → wheel tags that run there: glibc 2.28, macOS 14 or newer (some wheels ask for 13)."""


@dataclass(frozen=True, kw_only=True)
class Line:
    """Blender versions of one Python. since, before: first version in it, and the first that is not ("" for open).

    numpy: what these Blenders ship; wheels must fit it, because it is never bundled.
    """

    python: str
    since: str
    before: str
    numpy: str


LINES = {
    "blender-4.5": Line(python="3.11", since="4.5.0", before="5.1.0", numpy="numpy>=1.26,<2"),
    "blender-5.2": Line(python="3.13", since="5.1.0", before="", numpy="numpy>=2.2,<2.4"),
}
"""The LTS that each is tested with."""

NAMES = ("any", *(f"{platform}-{line}" for line in LINES for platform in PLATFORMS))


def build(name: str, out: Path, wheels: Path | None) -> Path:
    """Build the zip ``name`` into ``out``. Raises subprocess.CalledProcessError where wheels cannot be had.

    wheels: where downloads are kept; None builds ``any`` without a wheel, by the standard library alone.
    """
    manifest = read_manifest(ROOT)
    target, fields = None, {}
    if name != "any":
        place, _, rest = name.partition("-blender-")
        line = LINES[f"blender-{rest}"]
        target = Target(python=line.python, platforms=PLATFORMS[place], numpy=line.numpy)
        fields = {"platforms": [place], "blender_version_min": line.since}
        if line.before:
            fields["blender_version_max"] = line.before
    files: list[Path] = []
    if wheels is not None:
        files = all_wheels(ROOT, target, wheels) if target else pure_wheels(ROOT, wheels)
    suffix = "" if name == "any" else f"-{name}"
    path = out / f"{manifest['id']}-{manifest['version']}{suffix}.zip"
    write_zip(ROOT, path, fields, files)
    return path


def default_zips() -> list[str]:
    """The zips of use on this machine."""
    here = {"Linux": "linux-x64", "Windows": "windows-x64", "Darwin": "macos-arm64"}.get(platform.system(), "")
    return [name for name in NAMES if name == "any" or (here and name.startswith(here))]


_SAME_TIME = (1980, 1, 1, 0, 0, 0)
"""The same tree gives the same zip, to the byte."""


def read_manifest(root: Path) -> dict[str, Any]:
    """The manifest of the tree at ``root``."""
    return tomllib.loads((root / MANIFEST).read_text(encoding="utf-8"))


def source_files(root: Path, patterns: Sequence[str]) -> Iterator[str]:
    """Files of the tree that no pattern leaves out, as paths relative to ``root``, sorted, without the manifest.

    patterns: as ``[build] paths_exclude_pattern`` has them: a slash in front means the top folder only, one behind
    means folders only.
    """
    for folder, folders, names in os.walk(root):
        here = Path(folder).relative_to(root)
        folders[:] = sorted(name for name in folders if not _left_out(here / name, True, patterns))
        for name in sorted(names):
            path = here / name
            if path.as_posix() != MANIFEST and not _left_out(path, False, patterns):
                yield path.as_posix()


def _left_out(path: Path, is_folder: bool, patterns: Iterable[str]) -> bool:
    for pattern in patterns:
        if pattern.endswith("/") and not is_folder:
            continue
        bare = pattern.strip("/")
        if fnmatch(path.as_posix() if pattern.startswith("/") else path.name, bare) and not (
            pattern.startswith("/") and len(path.parts) > 1
        ):
            return True
    return False


def manifest_text(manifest: Mapping[str, Any], fields: Mapping[str, Any], wheels: Sequence[str]) -> str:
    """``manifest`` with ``fields`` instead of its own and ``wheels`` (file names), as TOML; without how it is built."""
    values = {**manifest, **fields}
    if wheels:
        values["wheels"] = [f"./wheels/{name}" for name in wheels]
    values.pop("build", None)
    tables = {key: value for key, value in values.items() if isinstance(value, dict)}
    lines = [f"{key} = {_toml(value)}" for key, value in values.items() if key not in tables]
    for key, table in tables.items():
        lines += ["", f"[{key}]", *(f"{name} = {_toml(value)}" for name, value in table.items())]
    return "\n".join(lines) + "\n"


def _toml(value: str | list[str]) -> str:
    """A string or a list of strings; JSON's quoting is TOML's."""
    if isinstance(value, str):
        return json.dumps(value, ensure_ascii=False)
    items = [json.dumps(item, ensure_ascii=False) for item in value]
    return "[" + ", ".join(items) + "]" if len(items) < 4 else "[\n" + "".join(f"    {i},\n" for i in items) + "]"


def write_zip(root: Path, path: Path, fields: Mapping[str, Any], wheels: Sequence[Path]) -> None:
    """Write the extension at ``root`` with ``wheels`` to ``path``, whole or not at all."""
    manifest = read_manifest(root)
    names = list(source_files(root, manifest["build"]["paths_exclude_pattern"]))
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_suffix(".partial")
    with zipfile.ZipFile(partial, "w") as archive:
        text = manifest_text(manifest, fields, [wheel.name for wheel in wheels])
        _add(archive, MANIFEST, text.encode(), zipfile.ZIP_DEFLATED)
        for name in names:
            _add(archive, name, (root / name).read_bytes(), zipfile.ZIP_DEFLATED)
        for wheel in wheels:
            # Wheels are compressed already.
            _add(archive, f"wheels/{wheel.name}", wheel.read_bytes(), zipfile.ZIP_STORED)
    partial.replace(path)


def _add(archive: zipfile.ZipFile, name: str, content: bytes, compression: int) -> None:
    entry = zipfile.ZipInfo(name, _SAME_TIME)
    entry.compress_type = compression
    entry.external_attr = 0o644 << 16
    archive.writestr(entry, content)


def requirements(root: Path, python: str) -> list[str]:
    """Return the requirements of the project at ``root`` for that Python, markers resolved (pip would use its own)."""
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


def main() -> int:
    """Entry of the script; 0 when all zips are built."""
    parser = argparse.ArgumentParser(prog="extension.py", description="Build the zips that Blender installs.")
    parser.add_argument("--zips", nargs="*", choices=["all", *NAMES], metavar="NAME", help=f"all, {', '.join(NAMES)}")
    parser.add_argument("--out", type=Path, default=ROOT / "dist")
    parser.add_argument("--wheels", type=Path, default=ROOT / "build" / "wheels", help="where downloads are kept")
    alone = "build `any` without trimesh, which reads mesh files: neither pip nor a network is needed"
    parser.add_argument("--no-wheels", action="store_true", help=alone)
    options = parser.parse_args()
    if options.no_wheels:
        options.zips, options.wheels = ["any"], None
    names = NAMES if options.zips and "all" in options.zips else options.zips or default_zips()
    for name in names:
        try:
            path = build(name, options.out, options.wheels)
        except subprocess.CalledProcessError as error:
            sys.stderr.write(f"{name}: pip could not get the wheels:\n{error.stderr}\n")
            return 1
        sys.stdout.write(f"{path} ({path.stat().st_size / 2**20:.1f} MiB)\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
