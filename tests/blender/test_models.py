# SPDX-License-Identifier: GPL-3.0-or-later
"""Improve Cut-outs: what is agreed to is installed in the user's folder by the command, and the photo panel follows."""

import gzip
import os
from pathlib import Path

import pytest

bpy = pytest.importorskip("bpy")
from physgen.physgen_addon.operators import install_ops
from physgen.physgen_addon.panels.photo_panel import draw_cutouts
from physgen.sim.reconstruct.models import model_folder
from physgen.sim.reconstruct.models.known_models import ISNET

from .checked_layout import CheckedLayout, Context, Drawn

pytestmark = pytest.mark.usefixtures("addon")

ARCHIVE = os.environ.get("PHYSGEN_TEST_ISNET", "")


@pytest.fixture(autouse=True)
def own_models(tmp_path, monkeypatch):
    monkeypatch.setenv(model_folder.VARIABLE, str(tmp_path / "models"))


def drawn():
    layout = CheckedLayout()
    draw_cutouts(layout, Context(), bpy.context.scene.physgen_photo)
    return layout.names


def test_nothing_happens_without_agreement(tmp_path):
    with pytest.raises(RuntimeError, match="not agreed to"):
        bpy.ops.physgen.improve_cutouts(archive=str(tmp_path / "any.tgz"))
    assert not (tmp_path / "models").exists()


def test_a_bad_archive_is_reported_and_installs_nothing(tmp_path):
    path = tmp_path / "bad.tgz"
    path.write_bytes(gzip.compress(bytes(2048)))
    with pytest.raises(RuntimeError, match="is not the archive of"):
        bpy.ops.physgen.improve_cutouts(archive=str(path), agreed=True)
    with pytest.raises(RuntimeError, match="there is no file"):
        bpy.ops.physgen.improve_cutouts(archive=str(tmp_path / "none.tgz"), agreed=True)
    assert not list((tmp_path / "models").glob("*"))


def test_nothing_is_fetched_while_blender_is_to_stay_offline():
    # As a module bpy has no network access, unless it is allowed in the preferences.
    if bpy.app.online_access:
        pytest.skip("this Blender may go online")
    with pytest.raises(RuntimeError, match="offline"):
        bpy.ops.physgen.improve_cutouts(agreed=True)


@pytest.mark.parametrize("kind", [install_ops.PHYSGEN_OT_improve_cutouts, install_ops.PHYSGEN_OT_install_python])
def test_each_dialog_says_what_it_installs_and_leads_online(kind):
    layout = CheckedLayout()
    kind.draw(Drawn(kind, layout), Context())
    # Long paths are wrapped, too.
    words = "".join(layout.words).replace(" ", "")
    assert "MB" in words and (str(model_folder.models_folder()) in words or "physgen-python" in words)
    assert kind.source in layout.names
    assert bpy.app.online_access or "screen.userpref_show" in layout.names


def test_the_panel_offers_the_installation_then_the_choice(tmp_path):
    assert drawn() == ["physgen.improve_cutouts"]
    path = model_folder.model_file(ISNET)
    path.parent.mkdir()
    with path.open("wb") as stream:
        stream.truncate(ISNET.size)
    assert drawn() == ["segmenter", "physgen.remove_model"]
    assert bpy.ops.physgen.remove_model() == {"FINISHED"}
    assert drawn() == ["physgen.improve_cutouts"] and not path.exists()
    assert not bpy.ops.physgen.remove_model.poll()


@pytest.mark.skipif(not ARCHIVE, reason="PHYSGEN_TEST_ISNET names no archive of the model")
def test_the_real_archive_is_installed():
    assert bpy.ops.physgen.improve_cutouts(archive=str(Path(ARCHIVE).resolve()), agreed=True) == {"FINISHED"}
    model_folder.check_installed(model_folder.model_file(ISNET), "test")
    assert model_folder.model_status(ISNET).is_installed
