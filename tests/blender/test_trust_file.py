# SPDX-License-Identifier: GPL-3.0-or-later
"""A .blend from somebody else reads nothing outside its folder before the user agreed; one's own needs no word."""

import numpy as np
import pytest
from PIL import Image

bpy = pytest.importorskip("bpy")
import physgen
from physgen.physgen_addon.operators.photo_ops import add_box, set_photo
from physgen.physgen_addon.photo import photo_trust
from physgen.sim.trust import NotTrusted


@pytest.fixture(autouse=True)
def addon(fresh_blender, tmp_path, monkeypatch):
    monkeypatch.setenv("PHYSGEN_CONFIG", str(tmp_path / "config"))
    physgen.register()
    yield
    physgen.unregister()


@pytest.fixture
def blend(tmp_path):
    """A file in a folder of its own that names a photo and a mesh elsewhere, saved by its maker."""
    secret = tmp_path / "elsewhere" / "private.png"
    secret.parent.mkdir()
    Image.fromarray(np.full((60, 80, 3), 90, np.uint8)).save(secret)
    (secret.parent / "private.obj").write_text("v 0 0 0\n")
    set_photo(bpy.context.scene, secret)
    box = add_box(bpy.context.scene, (10, 10, 50, 50), "ball")
    box.mesh = str(secret.parent / "private.obj")
    path = tmp_path / "downloaded" / "toy.blend"
    path.parent.mkdir()
    bpy.ops.wm.save_as_mainfile(filepath=str(path))
    return path


def test_ones_own_file_needs_no_word(blend):
    assert photo_trust.pending(bpy.context.scene) == []
    bpy.ops.wm.open_mainfile(filepath=str(blend))
    assert photo_trust.pending(bpy.context.scene) == []


def test_somebody_elses_reads_nothing_outside_its_folder_before_the_word(blend, tmp_path, monkeypatch):
    monkeypatch.setenv("PHYSGEN_CONFIG", str(tmp_path / "another user"))
    bpy.ops.wm.open_mainfile(filepath=str(blend))
    scene = bpy.context.scene
    lines = [claim.line() for claim in photo_trust.pending(scene)]
    assert [line.split(" = ")[0] for line in lines] == ["reads photo", "reads ball: mesh"]
    with pytest.raises(RuntimeError, match=r"you have not agreed to them: reads photo = .*private\.png"):
        bpy.ops.physgen.reconstruct()
    with pytest.raises(NotTrusted):
        photo_trust.require_agreed(scene)
    # Saving it is no word, choosing a file is one for that file.
    bpy.ops.wm.save_mainfile()
    bpy.ops.wm.open_mainfile(filepath=str(blend))
    scene = bpy.context.scene
    assert len(photo_trust.pending(scene)) == 2
    scene.physgen_photo.boxes[0].mesh = str(tmp_path / "my own.obj")
    assert [claim.where for claim in photo_trust.pending(scene)] == ["photo"]
    # The question's yes.
    assert bpy.ops.physgen.trust_file() == {"FINISHED"}
    photo_trust.require_agreed(scene)


def test_a_yes_is_remembered_until_the_file_asks_for_something_else(blend, tmp_path, monkeypatch):
    monkeypatch.setenv("PHYSGEN_CONFIG", str(tmp_path / "another user"))
    bpy.ops.wm.open_mainfile(filepath=str(blend))
    bpy.ops.physgen.trust_file()
    bpy.ops.wm.open_mainfile(filepath=str(blend))
    assert photo_trust.pending(bpy.context.scene) == []
    monkeypatch.setenv("PHYSGEN_CONFIG", str(tmp_path / "maker"))
    bpy.context.scene.physgen_photo.depth = str(tmp_path / "elsewhere" / "more.exr")
    bpy.ops.wm.save_mainfile()
    monkeypatch.setenv("PHYSGEN_CONFIG", str(tmp_path / "another user"))
    bpy.ops.wm.open_mainfile(filepath=str(blend))
    assert "depth" in [claim.where for claim in photo_trust.pending(bpy.context.scene)]
