# SPDX-License-Identifier: MIT
"""Who may import whom (docs/design.md), read from the sources; and what the tree says of itself in several places."""

import ast
import re
import subprocess
import sys
import tomllib
from graphlib import TopologicalSorter
from pathlib import Path

import pytest
from physgen.sim.version import VERSION

ROOT = Path(__file__).resolve().parents[2]
MAY_IMPORT_TAICHI = ("sim/mpm", "sim/constitutive", "sim/gaussians", "sim/diagnose/rigid", "sim/diagnose/soft")
INTERFACE = ("operators", "panels", "preview", "background_jobs", "handlers", "gizmos", "bake_state", "unsaved_bakes")
UPWARD = {
    "props": INTERFACE,
    "frames": INTERFACE,
    "photo": INTERFACE,
    "playback": INTERFACE,
    "render": INTERFACE,
    "scene_io": INTERFACE,
    "preview": ("operators", "panels", "background_jobs", "handlers", "gizmos", "bake_state"),
    "operators": ("panels", "handlers", "gizmos"),
    "panels": (
        "handlers",
        "scene_io.export_scene",
        "scene_io.import_scene",
        "render.render_scene",
        "render.renderer",
    ),
}
"""Folder of the add-on → what of the add-on it must not import. Panels are drawn all the time, so nothing heavy."""


def sources(folder):
    return sorted((ROOT / folder).rglob("*.py"))


def imports(path):
    """Absolute names of everything that ``path`` imports, relative imports resolved against the tree."""
    package = path.relative_to(ROOT).parent.parts
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = package[: len(package) - node.level + 1] if node.level else ()
            yield ".".join([*base, *([node.module] if node.module else [])])
            if node.level and not node.module:
                yield from (".".join([*base, alias.name]) for alias in node.names)


@pytest.mark.parametrize("path", sources("sim") + sources("blind_check"), ids=lambda p: str(p.relative_to(ROOT)))
def test_sim_needs_no_blender_and_never_looks_upward(path):
    names = list(imports(path))
    assert not [n for n in names if n.split(".")[0] in ("bpy", "mathutils", "bmesh", "physgen_addon", "batch")]
    if not str(path.relative_to(ROOT).as_posix()).startswith(MAY_IMPORT_TAICHI):
        assert not [n for n in names if n.split(".")[0] == "taichi"]


def test_nothing_below_the_use_cases_imports_them():
    below = [path for path in sources("sim") if "app" not in path.relative_to(ROOT).parts]
    assert not [path for path in below if any(name.startswith("sim.app") for name in imports(path))]


def test_no_two_parts_of_sim_import_each_other():
    """Folders and files, directly or through others: in some order each needs only those before it."""
    needs = {}
    for path in sources("sim"):
        part = path.relative_to(ROOT / "sim").parts[0].removesuffix(".py")
        names = (name.split(".") for name in imports(path))
        needs.setdefault(part, set()).update(name[1] for name in names if name[0] == "sim" and len(name) > 1)
        needs[part].discard(part)
    order = list(TopologicalSorter(needs).static_order())  # Raises CycleError with the parts in a circle.
    assert order.index("scene") < min(order.index(part) for part in ("cache", "composite", "app"))


@pytest.mark.parametrize("path", sources("physgen_addon"), ids=lambda p: str(p.relative_to(ROOT)))
def test_the_addon_never_imports_taichi_or_batch(path):
    assert not [n for n in imports(path) if n.split(".")[0] in ("taichi", "batch")]


def test_only_its_command_imports_the_blind_check():
    importers = {
        path.relative_to(ROOT).as_posix()
        for folder in ("sim", "physgen_addon", "batch")
        for path in sources(folder)
        if any(name.split(".")[0] == "blind_check" for name in imports(path))
    }
    assert importers == {"batch/commands/diagnosis_commands.py"}


@pytest.mark.parametrize("folder", UPWARD)
def test_no_folder_of_the_addon_looks_upward(folder):
    found = {
        f"{path.relative_to(ROOT)}: {name}"
        for path in sources(f"physgen_addon/{folder}")
        for name in imports(path)
        for upper in UPWARD[folder]
        if f"{name}.".startswith(f"physgen_addon.{upper}.")
    }
    assert not found


@pytest.mark.parametrize(
    "path", sources("sim") + sources("physgen_addon") + sources("blind_check"), ids=lambda p: str(p.relative_to(ROOT))
)
def test_imports_inside_the_tree_are_relative(path):
    # Installed as an extension the package is bl_ext.<repository>.physgen.
    assert not [n for n in imports(path) if n.split(".")[0] == "physgen"]


def test_rendering_and_opening_a_scene_never_pay_for_taichi():
    code = "import sys, physgen.batch.cli, physgen.sim.app.bake, physgen.sim.effects.registry; print(*sys.modules)"
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert not {"taichi", "bpy"} & set(result.stdout.split())


def test_a_command_starts_without_what_only_another_needs():
    """Every bake, render and task of a farm starts one; each of these takes a quarter of a second or more."""
    code = "import sys, physgen.batch.cli; print(*sys.modules)"
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert not {"taichi", "bpy", "trimesh", "skimage", "scipy"} & set(result.stdout.split())


def test_one_version():
    assert tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["version"] == VERSION
    manifest = tomllib.loads((ROOT / "blender_manifest.toml").read_text())
    assert manifest["version"] == VERSION


def test_every_source_names_its_licence():
    for path in [p for folder in ("sim", "physgen_addon", "batch", "presets", "blind_check") for p in sources(folder)]:
        licence = "MIT" if path.relative_to(ROOT).parts[0] in ("sim", "presets", "blind_check") else "GPL-3.0-or-later"
        first = path.read_text(encoding="utf-8").splitlines()[0:2]
        assert any(re.search(rf"SPDX-License-Identifier: {licence}$", line) for line in first), path


def test_every_preset_says_where_its_numbers_come_from():
    for path in (ROOT / "presets" / "materials").glob("*.toml"):
        data = tomllib.loads(path.read_text(encoding="utf-8"))
        assert data["source"] and data["description"], path


LISTED = re.compile(r"\b(\w+)\.py\b")


@pytest.mark.parametrize("folder", ["sim/app", "sim/reconstruct/shape", "sim/diagnose/rigid", "physgen_addon/render"])
def test_a_large_folder_lists_its_files(folder):
    text = ast.get_docstring(ast.parse((ROOT / folder / "__init__.py").read_text(encoding="utf-8")))
    assert set(LISTED.findall(text)) == {path.stem for path in sources(folder)} - {"__init__"}
