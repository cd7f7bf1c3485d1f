# SPDX-License-Identifier: GPL-3.0-or-later
"""The asset library: built as ``make assets`` does, registered with consent, and dropped on objects."""

import runpy
from pathlib import Path

import pytest

bpy = pytest.importorskip("bpy")
import physgen
from physgen.physgen_addon.operators import asset_ops
from physgen.physgen_addon.props import material_props
from physgen.physgen_addon.props.body_props import bodies

SCRIPT = Path(physgen.__file__).resolve().parent / "setup" / "assets.py"


@pytest.fixture(scope="module")
def library(tmp_path_factory):
    """The library without the pictures, which take most of the time."""
    return runpy.run_path(str(SCRIPT))["build"](tmp_path_factory.mktemp("assets"), pixels=0, samples=1)


def assets(path):
    with bpy.data.libraries.load(str(path), assets_only=True) as (found, _):
        return list(found.materials), list(found.collections)


def dropped(path, name, item):
    """What a drop does: the material is appended, and becomes that of the object."""
    if name not in bpy.data.materials:
        with bpy.data.libraries.load(str(path), assets_only=True) as (_, wanted):
            wanted.materials = [name]
    item.data.materials.clear()
    item.data.materials.append(bpy.data.materials[name])
    item.update_tag()
    bpy.context.view_layer.update()


def a_cube():
    bpy.ops.mesh.primitive_cube_add()
    return bpy.context.object


def test_every_preset_is_an_asset_with_its_words(library, addon):
    materials, collections = assets(library)
    shipped = material_props.shipped_items()
    assert sorted(materials) == sorted(title for _, title, _ in shipped) and collections == ["PhysGen Sample"]
    catalogs = (library.parent / "blender_assets.cats.txt").read_text(encoding="utf-8")
    bpy.ops.wm.open_mainfile(filepath=str(library))
    for name, title, words in shipped:
        found = bpy.data.materials[title]
        assert found[asset_ops.PRESET] == name and found.asset_data.description == words
        assert found.asset_data.catalog_id in catalogs


def test_a_dropped_material_is_the_objects_matter(library, addon):
    cube, other = a_cube(), a_cube()
    dropped(library, "Jelly", cube)
    assert cube.physgen.material.preset == "jelly" and other.physgen.material.preset == "medium"
    # What is chosen afterwards stays, whatever else happens to the object.
    cube.physgen.material.preset = "wood"
    cube.location.x = 1.0
    bpy.context.view_layer.update()
    assert cube.physgen.material.preset == "wood"
    dropped(library, "Snow", cube)
    assert cube.physgen.material.preset == "snow"
    plain = bpy.data.materials.new("a colour")
    cube.data.materials[0] = plain
    cube.update_tag()
    bpy.context.view_layer.update()
    assert cube.physgen.material.preset == "snow", "a colour says nothing about matter"
    dropped(library, "Snow", other)
    assert other.physgen.material.preset == "snow"


def test_the_sample_brings_its_physics_along(library, addon):
    with bpy.data.libraries.load(str(library), assets_only=True) as (_, wanted):
        wanted.collections = ["PhysGen Sample"]
    bpy.context.scene.collection.children.link(bpy.data.collections["PhysGen Sample"])
    presets = {item.name: item.physgen.material.preset for item in bodies(bpy.context.scene)}
    assert presets["Jelly"] == "jelly" and presets["Sand"] == "sand" and presets["Wood"] == "wood"


def test_the_library_is_registered_once_and_only_where_there_is_one(library, addon, tmp_path):
    libraries = bpy.context.preferences.filepaths.asset_libraries
    before = len(libraries)
    try:
        with pytest.raises(RuntimeError, match=r"holds no physgen_assets\.blend"):
            bpy.ops.physgen.add_assets(directory=str(tmp_path))
        for _ in range(2):
            assert bpy.ops.physgen.add_assets(directory=str(library.parent)) == {"FINISHED"}
        assert len(libraries) == before + 1 and Path(libraries[asset_ops.LIBRARY].path) == library.parent
    finally:
        if asset_ops.LIBRARY in libraries:
            libraries.remove(libraries[asset_ops.LIBRARY])


def test_an_unknown_preset_of_a_strangers_material_changes_nothing(addon):
    cube, material = a_cube(), bpy.data.materials.new("strange")
    material[asset_ops.PRESET] = "../etc"
    cube.data.materials.append(material)
    assert asset_ops.take_dropped(bpy.context.scene.objects) == [] and cube.physgen.material.preset == "medium"
