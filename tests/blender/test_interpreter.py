# SPDX-License-Identifier: GPL-3.0-or-later
"""Which Python simulates: the one that somebody named or none, and what is said where it cannot."""

import importlib
import shlex
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest

bpy = pytest.importorskip("bpy")
import physgen
from physgen.physgen_addon import interpreter
from physgen.physgen_addon.props import preferences

from . import checked_layout


@pytest.fixture(autouse=True)
def unnamed(monkeypatch):
    monkeypatch.delenv(interpreter.VARIABLE, raising=False)
    interpreter.forget()


@pytest.fixture
def bare(tmp_path):
    """An environment without packages."""
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", str(tmp_path / "bäre env")], check=True)
    return tmp_path / "bäre env"


def test_blenders_own_is_taken_with_its_wheels():
    python = interpreter.find_python()
    assert str(python) == sys.executable
    assert interpreter.python_version(python).split(".")[:2] == [str(n) for n in sys.version_info[:2]]
    command = interpreter.cli_command(python, "effects")
    assert command[command.index("--packages") + 1] == interpreter.wheel_folder()
    assert b'"event": "done"' in subprocess.run(command, capture_output=True, check=True).stdout


def test_a_folder_of_an_environment_is_as_good_as_its_python(bare):
    with pytest.raises(interpreter.NoPython, match=r"named in the preferences, cannot simulate: it lacks numpy"):
        interpreter.find_python(str(bare))


def test_named_interpreter_is_kept_and_repaired_by_command(bare, monkeypatch):
    monkeypatch.setenv(interpreter.VARIABLE, str(bare))
    with pytest.raises(interpreter.NoPython, match=r"named in PHYSGEN_PYTHON.*taichi.*In a terminal: ") as raised:
        interpreter.find_python()
    assert raised.value.command.startswith(f"'{bare / 'bin' / 'python'}' -m pip install ")
    assert "'taichi>=1.7.4,<1.8'" in raised.value.command and "\n" not in raised.value.command
    assert interpreter.find_python(sys.executable) == interpreter.find_python(sys.executable), "preferences come first"


@pytest.mark.parametrize("name", ["/nowhere/python", "/", "no-such-python"])
def test_interpreter_that_does_not_start_is_named(name):
    with pytest.raises(interpreter.NoPython, match=rf"{name}, named in the preferences, is no Python"):
        interpreter.find_python(name)


def test_output_of_other_programs_is_quoted():
    with pytest.raises(interpreter.NoPython, match="cannot simulate: "):
        interpreter.find_python("/bin/cat")
    with pytest.raises(interpreter.NoPython, match="it answered '/"):
        interpreter.find_python("/bin/echo")


def test_why_blenders_own_will_not_do():
    reason = interpreter.why_not((3, 14), "", "it lacks numpy")
    assert "need Python 3.11 to 3.13, and Blender's own is 3.14: press Install" in reason
    lacking = interpreter.why_not((3, 13), "", "it lacks taichi")
    assert "without its simulation packages: press Install" in lacking
    assert "(Taichi does not load)" in interpreter.why_not((3, 11), "/wheels", "Taichi does not load")


@pytest.fixture
def nothing_set_up(tmp_path, monkeypatch):
    """Blender's own Python without wheels, and nothing in the home folder."""
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.setattr(sys, "path", [path for path in sys.path if not (Path(path) / "taichi").is_dir()])
    # Other tests of this process have imported it.
    monkeypatch.delitem(sys.modules, "taichi", raising=False)
    importlib.invalidate_caches()


@pytest.mark.usefixtures("addon")
def test_what_is_to_be_set_up_is_said_before_anything_is_tried(nothing_set_up, tmp_path, monkeypatch):
    scene_panel, own_page = bpy.types.PHYSGEN_PT_scene, preferences.PHYSGEN_AP_preferences
    install = "physgen.install_python"
    assert not interpreter.is_set_up()
    shown = checked_layout.draw(scene_panel)
    assert install in shown.names and "not set up yet" in " ".join(shown.words)
    page = SimpleNamespace(python="", progress_text="", check="", bl_rna=own_page.bl_rna)
    page.layout = checked_layout.CheckedLayout()
    own_page.draw(page, checked_layout.Context())
    assert install in page.layout.names
    monkeypatch.setenv(interpreter.VARIABLE, sys.executable)
    assert interpreter.is_set_up() and install not in checked_layout.draw(scene_panel).names
    monkeypatch.delenv(interpreter.VARIABLE)
    (tmp_path / "physgen-python").symlink_to(sys.prefix)
    assert interpreter.is_set_up() and install not in checked_layout.draw(scene_panel).names


def test_the_environment_that_the_command_makes_is_found_unnamed(tmp_path, monkeypatch):
    home = tmp_path / "it's $HOME"
    home.mkdir()
    monkeypatch.setenv("HOME", str(home))
    monkeypatch.setattr(sys, "executable", "/bin/echo")
    with pytest.raises(interpreter.NoPython, match="Blender's own Python cannot simulate") as raised:
        interpreter.find_python()
    words = shlex.split(raised.value.command)
    place, python = str(home / "physgen-python"), str(home / "physgen-python" / "bin" / "python")
    assert words[1:8] == ["-m", "venv", place, "&&", python, "-m", "pip"]
    (home / "physgen-python").symlink_to(sys.prefix)
    assert str(interpreter.find_python()) == python


def test_incomplete_environment_is_completed(bare, monkeypatch):
    monkeypatch.setenv("HOME", str(bare.parent))
    monkeypatch.setattr(sys, "executable", "/bin/echo")
    (bare.parent / "physgen-python").symlink_to(bare)
    with pytest.raises(
        interpreter.NoPython, match="physgen-python/bin/python cannot simulate: it lacks numpy"
    ) as raised:
        interpreter.find_python()
    assert raised.value.command.startswith(f"{bare.parent}/physgen-python/bin/python -m pip install")


def test_check_reports_and_fails_with_the_remedy(bare, monkeypatch):
    physgen.register()
    try:
        assert bpy.ops.physgen.check_python() == {"FINISHED"}
        monkeypatch.setenv(interpreter.VARIABLE, str(bare))
        with pytest.raises(RuntimeError, match=r"it lacks numpy(.|\n)*pip install"):
            bpy.ops.physgen.check_python()
        assert preferences.python(bpy.context) == ""
    finally:
        physgen.unregister()


def test_a_python_to_start_from_is_found(tmp_path, monkeypatch):
    assert interpreter.find_base().is_file()
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.setattr(interpreter, "_USUAL_PLACES", ())
    assert interpreter.find_base().is_file(), "Blender's own will do"
    real = sys.executable
    monkeypatch.setattr(sys, "executable", "/bin/echo")
    with pytest.raises(interpreter.NoPython, match=r"no Python 3\.11 to 3\.13 with venv was found: install one"):
        interpreter.find_base()
    # As pyenv and uv keep them, which no program started from a desktop has on its search path.
    name = f"python3.{sys.version_info[1]}"
    own = tmp_path / ".pyenv" / "versions" / "any" / "bin" / name
    own.parent.mkdir(parents=True)
    own.symlink_to(real)
    assert interpreter.find_base() == own


def test_nothing_is_installed_without_agreement_or_from_a_folder_that_is_not_there(tmp_path, monkeypatch):
    monkeypatch.setenv("HOME", str(tmp_path))
    physgen.register()
    try:
        with pytest.raises(RuntimeError, match="not agreed to; nothing was installed"):
            bpy.ops.physgen.install_python()
        with pytest.raises(RuntimeError, match="there is no folder"):
            bpy.ops.physgen.install_python(agreed=True, wheels=str(tmp_path / "nothing"))
        if not bpy.app.online_access:
            with pytest.raises(RuntimeError, match="Allow Online Access"):
                bpy.ops.physgen.install_python(agreed=True)
    finally:
        physgen.unregister()
    assert not list(tmp_path.iterdir())
