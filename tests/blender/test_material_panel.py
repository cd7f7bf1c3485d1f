# SPDX-License-Identifier: GPL-3.0-or-later
"""Materials in the panel: presets, numbers with units, switches that stand for a number."""

import dataclasses

import pytest

bpy = pytest.importorskip("bpy")
from physgen.physgen_addon import text
from physgen.physgen_addon.props import material_props
from physgen.physgen_addon.props.material_props import LAW_FIELDS, get_material, is_modified
from physgen.physgen_addon.scene_io import import_physics
from physgen.sim.scene.material import LAWS

from .panel_scenes import a_body, a_cube, own_folder, select

pytestmark = pytest.mark.usefixtures("own_presets", "addon")


def test_a_changed_number_is_seen_and_taken_back():
    material = a_body().physgen.material
    for name in material_props._SHIPPED.good:
        material.preset = name
        assert material.preset == name and not is_modified(material), name
    material.preset = "rubber"
    material.youngs_modulus *= 1.01
    assert is_modified(material) and material.preset == "rubber"
    assert bpy.ops.physgen.reset_preset() == {"FINISHED"} and not is_modified(material)
    material.preset = "custom"
    material.density = 5
    assert not is_modified(material) and material.preset == "custom" and material.density == 5
    assert bpy.ops.physgen.reset_preset() == {"CANCELLED"}
    material.preset = "wood"
    assert material.law == "rigid" and material.density == 550


def test_a_preset_of_ones_own(tmp_path):
    item = a_body()
    material = item.physgen.material
    material.preset = "clay"
    material.density, material.fibre_axis = 1234.5, (0.6, 0.0, 0.8)
    assert bpy.ops.physgen.save_preset(name=" My clay ") == {"FINISHED"}
    assert material.preset == "My clay" and not is_modified(material)
    other = a_body("other").physgen.material
    other.preset = "My clay"
    assert get_material(other) == get_material(material) and other.density == 1234.5
    with pytest.raises(RuntimeError, match="is a shipped preset"):
        bpy.ops.physgen.save_preset(name="CLAY")
    with pytest.raises(RuntimeError, match="preset name"):
        bpy.ops.physgen.save_preset(name="a/b")
    assert bpy.ops.physgen.delete_preset(name="My clay") == {"FINISHED"}
    assert material.preset == "custom" and material.density == 1234.5
    with pytest.raises(RuntimeError, match="already be deleted"):
        bpy.ops.physgen.delete_preset(name="My clay")
    assert not list(own_folder(tmp_path).iterdir())


def test_a_preset_is_kept_by_name_where_it_is_missing(tmp_path):
    material = a_body("ball").physgen.material
    material.law, material.density = "rigid", 777
    bpy.ops.physgen.save_preset(name="é oak")
    bpy.ops.physgen.save_preset(name="a first")
    material.preset = "é oak"
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "a.blend"))
    for path in own_folder(tmp_path).iterdir():
        path.unlink()
    material_props.forget_presets()
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "a.blend"))
    material = bpy.data.objects["ball"].physgen.material
    assert (material.preset, material.law, material.density) == ("é oak", "rigid", 777)
    assert not is_modified(material) and get_material(material).preset == "é oak"
    assert ("é oak", "é oak (missing)") in [item[:2] for item in material_props.preset_items(material.preset_name)]
    material.preset = "é oak"
    assert material.density == 777
    material.preset = "rubber"
    assert material.density == 1100 and "é oak" not in [
        item[0] for item in material_props.preset_items(material.preset_name)
    ]


def test_broken_presets_are_listed_and_change_nothing(tmp_path):
    folder = own_folder(tmp_path, create=True)
    (folder / "bad.toml").write_bytes(b"\xff[[")
    (folder / "rubber.toml").write_text("density = 1.0")
    (folder / "good.toml").write_text("density = 2.0")
    material_props.forget_presets()
    material = a_body().physgen.material
    assert (
        set(material_props.own_presets().broken) == {"bad", "rubber"}
        and material_props.find_preset("rubber").density == 1100
    )
    material.preset = "broken:bad"
    assert material.preset == "medium" and material.density == 1000
    material.preset = "good"
    assert material.density == 2
    with pytest.raises(TypeError):
        material.preset = "nothing like it"
    assert bpy.ops.physgen.delete_preset(name="bad") == {"FINISHED"} and not (folder / "bad.toml").exists()


def test_copying_a_material():
    one, two, wall = a_body("a"), a_body("b"), a_cube("c")
    one.physgen.material.preset = "jelly"
    one.physgen.material.density = 900
    select(one, two, wall)
    assert bpy.ops.physgen.copy_material() == {"FINISHED"}
    assert two.physgen.material.preset == "jelly" and two.physgen.material.density == 900
    assert is_modified(two.physgen.material) and wall.physgen.material.preset == "medium"
    select(one)
    assert not bpy.ops.physgen.copy_material.poll()


def test_every_law_shows_fields_that_exist():
    material = a_body().physgen.material
    assert set(LAW_FIELDS) == set(LAWS)
    for fields in LAW_FIELDS.values():
        assert all(hasattr(material, name) for name in fields)


@pytest.mark.parametrize(
    ("pascals", "words"), [(100, "100 Pa"), (999.9, "1 kPa"), (5e5, "500 kPa"), (1.25e6, "1.25 MPa"), (7e10, "70 GPa")]
)
def test_pressures_are_readable(pascals, words):
    assert text.pressure(pascals) == words


def test_a_switch_stands_for_a_number_that_is_not_zero():
    rendering = bpy.context.scene.physgen.rendering
    assert not rendering.blurs_depth and rendering.f_number == 0
    rendering.blurs_depth = True
    assert rendering.f_number == pytest.approx(2.8)
    rendering.f_number = 4.0
    rendering.blurs_depth = True
    assert rendering.f_number == 4.0, "switching on what is on has changed the number"
    rendering.blurs_depth = False
    assert rendering.f_number == 0
    body = a_body().physgen
    assert body.surface == "GROUND"
    body.surface = "OWN"
    assert body.own_surface


# -- units ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("words", "pascals"),
    [
        ("2 MPa", 2e6),
        ("2MPa", 2e6),
        ("2 mpa", 2e6),
        ("1.5e3", 1.5e6),
        ("30", 30e3),
        ("100 psi", 689475.7),
        ("soft", 5e5),
        ("3 kg", 5e5),
        ("", 5e5),
        ("-5 kPa", 0.0),
    ],
)
def test_a_stiffness_is_typed_with_its_unit(words, pascals):
    """A bare number has the unit that was shown, as in Blender's own fields; what is no number changes nothing."""
    material = a_body().physgen.material
    material.youngs_modulus = 5e5
    assert material.youngs_modulus_shown == "500 kPa"
    material.youngs_modulus_shown = words
    least = material.bl_rna.properties["youngs_modulus"].hard_min
    assert material.youngs_modulus == pytest.approx(max(pascals, least), rel=1e-6)


def test_units_are_the_scenes():
    material = a_body().physgen.material
    units = bpy.context.scene.unit_settings
    material.youngs_modulus, material.density, material.viscosity = 1e6, 1000.0, 0.001
    shown = {}
    for units.system in ("METRIC", "IMPERIAL", "NONE"):
        shown[units.system] = (material.youngs_modulus_shown, material.density_shown, material.viscosity_shown)
    assert shown["METRIC"] == ("1 MPa", "1000 kg/m³", "1 mPa s")
    assert shown["IMPERIAL"] == ("145 psi", "62.43 lb/ft³", "1 mPa s")
    assert shown["NONE"] == ("1000000", "1000", "0.001")
    units.system = "IMPERIAL"
    material.density_shown = "1 g/cm3"
    assert material.density == pytest.approx(1000.0)
    material.density_shown = "10"
    assert material.density == pytest.approx(160.18463)


def test_looking_at_a_number_does_not_round_it():
    material = a_body().physgen.material
    material.youngs_modulus = 1234567.0
    assert material.youngs_modulus_shown == "1.235 MPa"
    material.youngs_modulus_shown = material.youngs_modulus_shown
    assert material.youngs_modulus == 1234567.0


def test_numbers_with_units_come_back_from_their_own_words():
    for kind in (text.PRESSURE, text.DENSITY, text.VISCOSITY):
        for system in ("METRIC", "IMPERIAL", "NONE"):
            for value in (0.0, 1.2e-4, 0.7, 42.0, 999.96, 1e4, 7.85e10):
                words = text.quantity(value, kind, system)
                found = text.typed_quantity(words, kind, words)
                assert found == pytest.approx(value, rel=1e-3), (words, value)


def test_size_is_in_per_cent():
    rendering = bpy.context.scene.physgen.rendering
    assert rendering.size == pytest.approx(100.0)
    rendering.size = 50.0
    assert rendering.scale == pytest.approx(0.5)
    rendering.scale = 0.25
    assert rendering.size == pytest.approx(25.0) and rendering.bl_rna.properties["size"].subtype == "PERCENTAGE"


def test_recognised_numbers_are_called_by_what_they_are_like():
    material = a_body().physgen.material
    import_physics.fill_material(material, dataclasses.replace(material_props.find_preset("hard"), density=840.0))
    assert material.preset == "custom"
    names = {item[0]: item[1] for item in material_props.preset_items(material.preset_name, material.likeness)}
    assert names["custom"] == "Like Plastic (hard)"
    import_physics.fill_material(material, material_props.find_preset("wood"))
    assert (material.preset, material.likeness) == ("wood", "")


def test_materials_are_in_the_order_of_their_titles():
    """A menu in the order of hidden names has Plastic (hard) between Foam and Honey."""
    titles = [title for _, title, _ in material_props.shipped_items()]
    assert titles == sorted(titles) and "Plastic (hard)" in titles
    box = bpy.context.scene.physgen_photo.boxes.add()
    choices = box.bl_rna.properties["preset"].enum_items
    assert [item.name for item in choices] == ["Automatic", *titles]
    # Files have the numbers, which follow the names.
    assert [item.identifier for item in sorted(choices, key=lambda item: item.value)[1:]] == sorted(
        item[0] for item in material_props.shipped_items()
    )
