# SPDX-License-Identifier: MIT
"""Material presets of one's own: what is written comes back, and garbage in the folder spoils nothing."""

import dataclasses

import pytest
from physgen.sim.errors import InputError
from physgen.sim.scene.material import (
    MAX_PRESET_BYTES,
    PRESET_FOLDER,
    Material,
    delete_preset,
    load_preset,
    preset_names,
    read_presets,
    save_preset,
)

OAK = Material(density=700.5, law="von_mises", yield_stress=1e-7 + 2.0, fibre_axis=(0.6, 0.0, 0.8), viscosity=1e-5)


def test_preset_round_trip(tmp_path):
    folder = tmp_path / "not yet" / "é"
    save_preset(folder, "Old oak-1", OAK, 'says "so"\n\tand \\ more \x7f ü')
    found = read_presets(folder)
    assert found.good == {"Old oak-1": dataclasses.replace(OAK, preset="Old oak-1")}
    assert found.descriptions["Old oak-1"] == 'says "so"\n\tand \\ more \x7f ü' and not found.broken
    save_preset(folder, "Old oak-1", dataclasses.replace(OAK, density=1.0))
    assert read_presets(folder).good["Old oak-1"].density == 1.0
    assert [path.name for path in folder.iterdir()] == ["Old oak-1.toml"]


@pytest.mark.parametrize("name", ["", " a", "a/b", "..", "a.b", "x" * 49, "CON", "lpt1", "custom", "Rubber", "a\nb"])
def test_a_name_that_cannot_be_is_refused(tmp_path, name):
    with pytest.raises(InputError, match="preset name"):
        save_preset(tmp_path, name, OAK)
    assert not list(tmp_path.iterdir())


GARBAGE = {
    "bytes": b"\xff\xfe\x00",
    "nan": b"density = nan\n",
    "range": b"poisson_ratio = 0.9\n",
    "unknown": b"colour = 'red'\n",
    "type": b"density = 'heavy'\n",
    "deep": b"a = " + b"[" * 20000,
    "huge number": b"density = " + b"9" * 5000,
    "large": b"#" * (MAX_PRESET_BYTES + 1),
    "law": b"law = 'magic'\n",
    "axis": b"fibre_axis = [0.0, 1.0]\n",
}


def test_garbage_is_named_and_the_rest_is_read(tmp_path):
    for name, content in GARBAGE.items():
        (tmp_path / f"{name}.toml").write_bytes(content)
    (tmp_path / "a folder.toml").mkdir()
    (tmp_path / "b@d.toml").write_text("density = 1.0")
    (tmp_path / "notes.txt").write_text("not a preset")
    save_preset(tmp_path, "fine", OAK)
    found = read_presets(tmp_path)
    assert list(found.good) == ["fine"]
    assert set(found.broken) == {*GARBAGE, "a folder", "b@d"}
    assert "poisson_ratio" in found.broken["range"] and "colour" in found.broken["unknown"]
    delete_preset(tmp_path, "deep")
    assert "deep" not in read_presets(tmp_path).broken
    with pytest.raises(InputError, match="may already be deleted"):
        delete_preset(tmp_path, "deep")
    with pytest.raises(InputError, match="cannot be deleted"):
        delete_preset(tmp_path, "a folder")


def test_missing_preset_folder_is_empty(tmp_path):
    assert not read_presets(tmp_path / "nowhere").good
    (tmp_path / "file").write_text("")
    assert not read_presets(tmp_path / "file").good
    with pytest.raises(InputError, match="cannot be written"):
        save_preset(tmp_path / "file", "oak", OAK)


def test_the_shipped_ones_are_presets_like_any():
    found = read_presets(PRESET_FOLDER)
    assert sorted(found.good) == preset_names() and not found.broken
    assert found.good["rubber"] == load_preset("rubber") and all(found.descriptions.values())
