# SPDX-License-Identifier: MIT
"""A folder from somebody else whose parts are links, or name what lies outside: nothing there is read or written."""

import json
import shutil
import sys

import pytest
from physgen.batch import cli
from physgen.benchmarks.kills import contents
from physgen.sim.app.import_folder import import_folder
from physgen.sim.errors import InputError

from .limited_commands import draw

pytestmark = pytest.mark.skipif(not sys.platform.startswith("linux"), reason="inputs are drawn with limits of Linux")


@pytest.fixture(scope="module")
def inputs(tmp_path_factory):
    """A folder with a scene, a bake of it, the same packed, a table, a case of a questionnaire."""
    folder = tmp_path_factory.mktemp("hostile") / "start"
    draw(folder)
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        assert cli.main(["pack", "whole", "--out", "packed"]) == 0
    return folder


@pytest.fixture
def work(inputs, tmp_path, monkeypatch):
    """A copy of the inputs, the working folder."""
    shutil.copytree(inputs, tmp_path / "work")
    monkeypatch.chdir(tmp_path / "work")
    monkeypatch.setenv("PHYSGEN_CONFIG", str(tmp_path / "config"))
    return tmp_path / "work"


def moved_out(work, name):
    """Move the file or folder ``name`` beside the working folder, and put a link in its place."""
    outside = work.parent / "outside"
    outside.mkdir()
    (work / name).rename(outside / "target")
    (work / name).symlink_to(outside / "target")
    return outside


LINKED = {
    "pair/meshes": (
        "check pair",
        "estimate pair",
        "variant pair --preset jelly --out windy",
        "light pair --sun-direction 0.5,0.3,1 --sun-strength 2",
        "export pair --usd moving.usda",
        "compose pair --no-picture --steps 1 --substeps 1 --cells 8 --out fitted",
        "bake pair --frames 1 --quality preview --out bake",
        "evaluate whole --scene pair --out evaluated",
    ),
    "pair/scene.json": ("check pair", "variant pair --preset jelly --out windy", "estimate pair"),
    "whole/manifest.json": ("check whole", "free whole", "export pair --bake whole --usd moving.usda"),
    "packed/packed.json": ("pack packed --unpack --out unpacked",),
}


@pytest.mark.parametrize("name", LINKED)
def test_a_part_that_is_a_link_out_of_its_folder_is_not_read(work, capsys, name):
    outside = moved_out(work, name)
    before = contents(work), contents(outside)
    for command in LINKED[name]:
        capsys.readouterr()
        assert cli.main(command.split()) == 3, command
        said = capsys.readouterr().err
        assert "leads out of" in said and "Traceback" not in said, command
        assert (contents(work), contents(outside)) == before, command


@pytest.mark.parametrize("name", ["../../outside.pc2", "/etc/passwd", "a/../../x", "a\\..\\x", "nul\0"])
def test_a_packed_bake_unpacks_nowhere_else(work, capsys, name):
    path = work / "packed" / "packed.json"
    record = json.loads(path.read_text())
    record["manifest"]["objects"][0]["file"] = name
    path.write_text(json.dumps(record))
    before = contents(work.parent)
    assert cli.main(["pack", "packed", "--unpack", "--out", "unpacked"]) == 3
    assert "error: " in capsys.readouterr().err
    assert contents(work.parent) == before


URDF = "<robot name='r'><link name='a'><visual><geometry><mesh filename='{}'/></geometry></visual></link></robot>"
MJCF = (
    "<mujoco><compiler meshdir='{}'/><asset><mesh name='m' file='x.stl'/></asset><worldbody><body><freejoint/>"
    "<geom type='mesh' mesh='m'/></body></worldbody></mujoco>"
)


@pytest.mark.parametrize(
    "text",
    [
        URDF.format("package://robot/../../x.stl"),
        URDF.format("package://../../x.stl"),
        URDF.format("file:///etc/x.stl"),
        URDF.format("model://x.stl"),
        URDF.format("http://127.0.0.1/x.stl"),
        URDF.format("link/x.stl"),
        MJCF.format(".."),
        MJCF.format("/etc"),
        MJCF.format("link"),
    ],
)
def test_a_model_of_a_robot_names_no_mesh_outside_its_folder(tmp_path, text):
    (tmp_path / "model").mkdir()
    (tmp_path / "x.stl").write_text("solid x\nendsolid x\n")
    (tmp_path / "model" / "link").symlink_to(tmp_path)
    (tmp_path / "model" / "m.xml").write_text(text)
    with pytest.raises(InputError, match=r"leads out of|must be relative to"):
        import_folder(tmp_path / "model" / "m.xml", out=tmp_path / "out")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    "line",
    [
        'segmenter = "python:x.py:f"',
        'depth_estimator = "command:x.toml"',
        'ask = "http://127.0.0.1/v1"',
        "trust = true",
        'reading = {mesher = "python:x.py:f"}',
        'out = "../elsewhere"',
        'render.video = ["/etc/x.mp4"]',
        'render.camera = "../camera.json"',
        'render.python = "x.py"',
        'bake.command = "x"',
    ],
)
def test_a_job_file_names_no_program_no_endpoint_and_no_file_outside(work, capsys, line):
    text = 'format = "physgen-jobs/1"\nname = "job"\n'
    scene = '[[scenes]]\nname = "a"\nscene = "pair"\n'
    path = work / "hostile.toml"
    path.write_text(f"{text}{line}\n{scene}" if line.startswith("out") else f"{text}{scene}{line}\n")
    before = contents(work)
    assert cli.main(["batch", "hostile.toml", "--workers", "1"]) == 3
    assert "hostile.toml" in capsys.readouterr().err
    assert contents(work) == before
