# SPDX-License-Identifier: GPL-3.0-or-later
"""``make extension``: the zips that Blender installs.

    python setup/extension.py [--zips NAME… | all] [--out dist] [--wheels build/wheels]

``any`` runs in every Blender from 4.5 and needs a Python of its own to simulate, named in the preferences; the others
hold all that simulates, for one platform and one line of Blender. Default: ``any`` and those for this platform. Only
what is not yet in the wheels' folder is downloaded.
"""

from __future__ import annotations

import argparse
import platform
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import extension_files
import extension_wheels
from extension_wheels import Target

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


def build(name: str, out: Path, wheels: Path) -> Path:
    """Build the zip ``name`` into ``out``. Raises subprocess.CalledProcessError where wheels cannot be had."""
    manifest = extension_files.read_manifest(ROOT)
    target, fields = None, {}
    if name != "any":
        place, _, rest = name.partition("-blender-")
        line = LINES[f"blender-{rest}"]
        target = Target(python=line.python, platforms=PLATFORMS[place], numpy=line.numpy)
        fields = {"platforms": [place], "blender_version_min": line.since}
        if line.before:
            fields["blender_version_max"] = line.before
    files = extension_wheels.all_wheels(ROOT, target, wheels) if target else extension_wheels.pure_wheels(ROOT, wheels)
    suffix = "" if name == "any" else f"-{name}"
    path = out / f"{manifest['id']}-{manifest['version']}{suffix}.zip"
    extension_files.write_zip(ROOT, path, fields, files)
    return path


def default_zips() -> list[str]:
    """The zips of use on this machine."""
    here = {"Linux": "linux-x64", "Windows": "windows-x64", "Darwin": "macos-arm64"}.get(platform.system(), "")
    return [name for name in NAMES if name == "any" or (here and name.startswith(here))]


def main() -> int:
    """Entry of the script; 0 when all zips are built."""
    parser = argparse.ArgumentParser(prog="extension.py", description="Build the zips that Blender installs.")
    parser.add_argument("--zips", nargs="*", choices=["all", *NAMES], metavar="NAME", help=f"all, {', '.join(NAMES)}")
    parser.add_argument("--out", type=Path, default=ROOT / "dist")
    parser.add_argument("--wheels", type=Path, default=ROOT / "build" / "wheels", help="where downloads are kept")
    options = parser.parse_args()
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
