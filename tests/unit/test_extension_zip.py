# SPDX-License-Identifier: GPL-3.0-or-later
"""The zip that Blender installs, built from this tree without the network, and its manifest as Blender reads it."""

import ast
import re
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path, PurePosixPath

import pytest

ROOT = Path(__file__).resolve().parents[2]
TAGS = {
    "3D View",
    "Add Curve",
    "Add Mesh",
    "Animation",
    "Bake",
    "Camera",
    "Compositing",
    "Development",
    "Game Engine",
    "Geometry Nodes",
    "Grease Pencil",
    "Import-Export",
    "Lighting",
    "Material",
    "Mesh",
    "Modeling",
    "Node",
    "Object",
    "Paint",
    "Physics",
    "Pipeline",
    "Render",
    "Rigging",
    "Scene",
    "Sculpt",
    "Sequencer",
    "System",
    "Text Editor",
    "Tracking",
    "User Interface",
    "UV",
}
"""Those of Blender's extension platform."""
NEEDED = {"schema_version", "id", "version", "name", "tagline", "maintainer", "type", "blender_version_min", "license"}
OPTIONAL = {"blender_version_max", "website", "copyright", "permissions", "tags", "platforms", "wheels"}


@pytest.fixture
def extension(monkeypatch):
    """The script ``setup/extension.py`` as a module."""
    monkeypatch.syspath_prepend(str(ROOT / "setup"))
    import extension

    return extension


@pytest.fixture
def archive(extension, tmp_path):
    extension.write_zip(ROOT, tmp_path / "out" / "physgen.zip", {}, [])
    with zipfile.ZipFile(tmp_path / "out" / "physgen.zip") as opened:
        yield opened


def version(text):
    assert re.fullmatch(r"\d+\.\d+\.\d+", text), text
    return tuple(int(n) for n in text.split("."))


def terse(text):
    """As the platform wants its one-line texts."""
    assert 0 < len(text) <= 64 and text == text.strip() and text[-1].isalnum(), text


def check_manifest(manifest):
    assert NEEDED <= set(manifest) <= NEEDED | OPTIONAL
    assert manifest["schema_version"] == "1.0.0" and manifest["type"] == "add-on"
    assert re.fullmatch("[a-z][a-z0-9]*(_[a-z0-9]+)*", manifest["id"])
    version(manifest["version"])
    terse(manifest["tagline"])
    assert manifest["license"] and all(re.fullmatch(r"SPDX:[\w.-]+", item) for item in manifest["license"])
    assert set(manifest["tags"]) <= TAGS
    if manifest.get("blender_version_max"):
        assert version(manifest["blender_version_min"]) < version(manifest["blender_version_max"])
    assert version(manifest["blender_version_min"]) >= (4, 5, 0)
    assert set(manifest["permissions"]) <= {"files", "network", "clipboard", "camera", "microphone"}
    for reason in manifest["permissions"].values():
        terse(reason)
    for wheel in manifest.get("wheels", ()):
        assert wheel.startswith("./wheels/") and 5 <= len(PurePosixPath(wheel).name.split("-")) <= 6, wheel


def test_the_manifest_of_the_tree_is_one_that_blender_takes(extension):
    manifest = extension.read_manifest(ROOT)
    patterns = manifest.pop("build")["paths_exclude_pattern"]
    assert len(patterns) == len(set(patterns))
    check_manifest(manifest)
    assert set(manifest["permissions"]) == {"files", "clipboard", "network"}
    assert "agree" in manifest["permissions"]["network"], "nothing is sent without consent"


def test_the_zip_holds_the_program_and_nothing_else(archive):
    names = archive.namelist()
    tops = {name.split("/")[0] for name in names}
    own = {"__init__.py", "blender_manifest.toml", "batch", "physgen_addon", "presets", "sim"}
    licences = {name for name in names if name.startswith("LICENSE")}
    assert licences == {"LICENSE", *(f"LICENSES/{name}.txt" for name in ("CC0-1.0", "GPL-3.0-or-later", "MIT"))}
    assert tops == own | {"README.md", "LICENSE", "LICENSES"}
    assert {PurePosixPath(name).suffix for name in names if name not in licences} == {
        ".py",
        ".toml",
        ".md",
        ".js",
        ".css",
        ".html",
        ".jpg",
    }
    tree = {
        p.relative_to(ROOT).as_posix() for top in ("batch", "physgen_addon", "sim") for p in ROOT.glob(f"{top}/**/*.py")
    }
    tree |= {p.relative_to(ROOT).as_posix() for p in ROOT.glob("presets/**/*.toml")}
    tree |= {p.relative_to(ROOT).as_posix() for top in ("batch", "sim") for p in ROOT.glob(f"{top}/**/*.html")}
    assert tree <= set(names)
    assert len(names) == len({name.lower() for name in names}), "names that differ in case only collide on Windows"


def test_its_own_modules_are_asked_for_relatively(archive):
    # Installed it is bl_ext.<repository>.physgen; an absolute import would find another version or none.
    for name in archive.namelist():
        if not name.endswith(".py"):
            continue
        for node in ast.walk(ast.parse(archive.read(name))):
            absolute = []
            if isinstance(node, ast.Import):
                absolute = [alias.name for alias in node.names]
            elif isinstance(node, ast.ImportFrom) and node.level == 0:
                absolute = [node.module]
            own = {"physgen", "sim", "batch", "presets", "physgen_addon"}
            assert not own & {module.split(".")[0] for module in absolute}, name


def test_its_manifest_says_what_is_in_it(archive):
    manifest = tomllib.loads(archive.read("blender_manifest.toml").decode())
    check_manifest(manifest)
    assert "wheels" not in manifest and "platforms" not in manifest and "blender_version_max" not in manifest
    assert f'"{manifest["version"]}"' in archive.read("sim/version.py").decode()


def test_a_zip_with_wheels_lists_them_and_where_it_runs(extension, tmp_path):
    wheels = [tmp_path / f"{name}-1.0-cp313-cp313-win_amd64.whl" for name in ("taichi", "scipy", "pillow", "trimesh")]
    for wheel in wheels:
        wheel.write_bytes(b"wheel")
    fields = {"platforms": ["windows-x64"], "blender_version_min": "5.1.0", "blender_version_max": "6.0.0"}
    extension.write_zip(ROOT, tmp_path / "a.zip", fields, wheels)
    extension.write_zip(ROOT, tmp_path / "b.zip", fields, wheels)
    assert (tmp_path / "a.zip").read_bytes() == (tmp_path / "b.zip").read_bytes(), "the same tree, the same zip"
    with zipfile.ZipFile(tmp_path / "a.zip") as opened:
        manifest = tomllib.loads(opened.read("blender_manifest.toml").decode())
        check_manifest(manifest)
        assert {**manifest, **fields} == manifest
        assert manifest["wheels"] == [f"./wheels/{wheel.name}" for wheel in wheels]
        assert {f"./{name}" for name in opened.namelist() if name.startswith("wheels/")} == set(manifest["wheels"])


@pytest.mark.parametrize(
    ("path", "folder", "out"),
    [
        ("tests", True, True),
        ("sim/tests", True, False),
        ("sim/__pycache__", True, True),
        (".git", True, True),
        ("sim/.hidden", False, True),
        ("docs", False, False),
        ("a.zip", False, True),
        ("sim/a.zip", False, False),
    ],
)
def test_patterns_leave_out_what_they_do_for_blender(extension, path, folder, out):
    patterns = extension.read_manifest(ROOT)["build"]["paths_exclude_pattern"]
    assert extension._left_out(Path(path), folder, patterns) is out


def test_every_zip_is_for_a_python_and_a_numpy_that_its_blender_has(extension):
    assert len(extension.NAMES) == 1 + 2 * 3 and extension.default_zips()[0] == "any"
    for line in extension.LINES.values():
        names = {re.split("[<>=]", item)[0] for item in extension.requirements(ROOT, line.python)}
        assert {"taichi", "trimesh", "openimageio"} <= names
        assert len(names) == len(extension.requirements(ROOT, line.python)), "one line a package"
    old, new = extension.requirements(ROOT, "3.11"), extension.requirements(ROOT, "3.13")
    assert "numpy>=1.26,<2" in old and "numpy>=1.26" in new, "markers are those of Blender's Python"
    assert "numpy" in extension.SHIPPED and extension._plain("Charset_Normalizer") in extension.SHIPPED


def test_the_zip_without_wheels_needs_the_standard_library_alone(tmp_path):
    # -I: no environment, no packages beside the script; -S: none of the interpreter's own.
    command = [sys.executable, "-I", "-S", str(ROOT / "setup" / "extension.py"), "--no-wheels", "--out", str(tmp_path)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    (path,) = tmp_path.glob("*.zip")
    with zipfile.ZipFile(path) as archive:
        names = archive.namelist()
    assert "blender_manifest.toml" in names and "physgen_addon/__init__.py" in names
    assert not any(name.endswith(".whl") for name in names)
