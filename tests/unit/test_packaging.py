# SPDX-License-Identifier: GPL-3.0-or-later
"""What a wheel of the project holds: every module and data file of the product, nothing else."""

import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
NOT_SHIPPED = {"tests", "benchmarks", "examples", "setup", "docs", "build", "dist", "demo_out", "site", "shared"}


def tree(suffixes):
    """Files of the product with these suffixes, as a wheel names them."""
    names = set()
    for top in ROOT.iterdir():
        # A virtual environment here has more files than all the rest.
        if top.name in NOT_SHIPPED or top.name.startswith("."):
            continue
        for path in (top, *top.rglob("*")):
            parts = path.relative_to(ROOT).parts
            if path.suffix in suffixes and not any(p.startswith(".") for p in parts):
                names.add("/".join(("physgen", *parts)))
    return names - {"physgen/setup.py"}


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    """Names in the wheel that this tree gives, built in a copy and without the network."""
    pytest.importorskip("setuptools")
    folder = tmp_path_factory.mktemp("wheel")
    left_out = shutil.ignore_patterns(".*", "*.egg-info", "build", "dist", "demo_out", "site", "__pycache__")
    shutil.copytree(ROOT, folder / "tree", ignore=left_out)
    command = [sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "--no-build-isolation"]
    command += ["--disable-pip-version-check", "--wheel-dir", str(folder), str(folder / "tree")]
    subprocess.run(command, check=True, capture_output=True, text=True)
    (built,) = folder.glob("*.whl")
    with zipfile.ZipFile(built) as archive:
        return {name for name in archive.namelist() if ".dist-info/" not in name}


def test_a_wheel_holds_every_module_and_nothing_else(wheel):
    assert {name for name in wheel if name.endswith(".py")} == tree({".py"})


def test_a_wheel_holds_the_data_that_the_program_reads(wheel):
    presets = {name for name in tree({".jpg", ".toml"}) if name.startswith("physgen/presets/")}
    others = tree({".css", ".html", ".js", ".typed"})
    assert len(presets) > 15 and {Path(name).suffix for name in others} == {".css", ".html", ".js", ".typed"}
    assert {name for name in wheel if not name.endswith(".py")} == presets | others
