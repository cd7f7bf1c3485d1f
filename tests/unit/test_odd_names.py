# SPDX-License-Identifier: MIT
"""Files, folders and objects called by anything: each command works or says one line, and nothing leaves its folder."""

import os
import shutil
import sys
from pathlib import Path

import pytest
from physgen.batch import cli
from physgen.sim.atomic import replacing, replacing_tree
from physgen.sim.errors import InputError
from physgen.sim.files import name_for_ffmpeg
from physgen.sim.reconstruct.reconstruct_options import ObjectRequest, object_names
from physgen.sim.scene.material import check_preset_name
from physgen.sim.scene.model import SceneObject
from physgen.sim.validation import valid_names

pytestmark = pytest.mark.skipif(os.name == "nt", reason="most of these names cannot be given there")

NAMES = {
    "everything": "a b'c\"d `id` $(touch x); & | ~ %04d 100%25 [1] * ? {x} ### <script>alert(1)<b>&amp; "
    "e\u0301 \u202e\u05d0\\nb",
    "line feed": "-\U0001f600\nb",
    "device": "con",
    "no UTF-8": "a\udcffb",
    "long": "n" * 190,
    "too long": "n" * 240,
}
COMMANDS = (
    ("variant", "{pair}", "--preset", "jelly", "--out={}windy"),
    ("light", "{pair}", "--sun-direction", "0.5,0.3,1", "--sun-strength", "2"),
    ("capture", "import", "{table}", "--diameter", "0.1", "--mass", "0.1", "--out={}captured"),
    ("questionnaire", "{answers}", "--collect", "--key", "key.json", "--out={}results"),
    ("pack", "{whole}", "--out={}packed"),
    ("pack", "{}packed", "--unpack", "--out={}unpacked"),
    ("evaluate", "{whole}", "--scene", "{pair}", "--out={}evaluated"),
    ("export", "{pair}", "--bake", "{whole}", "--usd={}moving.usda"),
)


@pytest.fixture(scope="module")
def inputs(tmp_path_factory):
    """A folder with the inputs of ``COMMANDS``."""
    if not sys.platform.startswith("linux"):
        pytest.skip("the inputs are drawn with limits of Linux")
    from .limited_commands import draw

    folder = tmp_path_factory.mktemp("odd") / "start"
    draw(folder, frames=3)
    return folder


@pytest.mark.parametrize("kind", NAMES)
def test_commands_work_in_and_on_folders_of_any_name_or_say_one_line(inputs, tmp_path, monkeypatch, capsys, kind):
    name = NAMES[kind]
    folder = tmp_path / "outer" / name
    shutil.copytree(inputs, folder)
    given = {}
    for file in ("pair", "whole", "table.csv", "answers.json"):
        there = folder / file
        # What is written is called by it, what is read as far as there may be such a name.
        given[there.stem] = f"./{name}{there.suffix}" if there.suffix else f"./{name}{file}"
        there.rename(folder / given[there.stem])
    monkeypatch.chdir(folder)
    for words in COMMANDS:
        line = [given.get(word.strip("{}"), word.replace("{}", f"./{name}")) for word in words]
        if words[0] == "evaluate" and kind != "everything":
            # A second of work.
            continue
        code = cli.main(line)
        said = capsys.readouterr()
        if kind == "no UTF-8" or (kind == "line feed" and words[0] == "export"):
            assert code == 3, (line, said.out)
        elif kind != "too long":
            assert code == 0, (line, said.err)
        if code:
            assert said.err.startswith("error: ") and said.err.count("\n") == 1 and ".partial" not in said.err, said.err
    assert [path.name for path in tmp_path.iterdir()] == ["outer"]
    assert [path.name for path in (tmp_path / "outer").iterdir()] == [name]
    pages = list(folder.rglob("*.html"))
    assert len(pages) >= 2 or kind != "everything"
    assert not any("<script>alert" in page.read_text() for page in pages)


@pytest.mark.parametrize("name", ["..", "../x", "a/b", "a\\b", "a\nb", "<b>", "a:b", "x.", "CON", "ground", "\udcff"])
def test_objects_that_no_file_may_be_called_by_are_refused_before_any_work(name):
    with pytest.raises(InputError, match=r"object\.name is "):
        object_names([ObjectRequest(name=name, box=(0, 0, 9, 9))])


def test_letters_of_every_script_name_objects_and_presets():
    """Vowels of Hindi and Thai are marks of their own, and macOS takes accents apart."""
    names = ["गेंद", "ลูกบอล", "كُرة", "u\u0308bung", "球"]
    assert object_names([ObjectRequest(name=name, box=(0, 0, 9, 9)) for name in names]) == names
    for name in names:
        SceneObject(name=name, mesh="-", size_m=1.0)
        check_preset_name(name)
    assert valid_names(["गेंद", "ลูกบอล"]) == ["गेंद", "ลูกบอล"]
    with pytest.raises(InputError, match="a name of its own"):
        object_names([ObjectRequest(name=name, box=(0, 0, 9, 9)) for name in ("\u00fcbung", "u\u0308bung")])


@pytest.mark.parametrize("write", [replacing, replacing_tree])
def test_a_name_too_long_is_said_to_be_and_how_long_it_may_be(tmp_path, write):
    with pytest.raises(InputError, match=r"at most \d+ bytes") as refused, write(tmp_path / ("n" * 240)):
        pass
    most = int(str(refused.value).split("at most ")[1].split()[0])
    with write(tmp_path / ("n" * most)) as partial:
        partial.mkdir(exist_ok=True)
    with pytest.raises(InputError, match="at most"), write(tmp_path / ("n" * (most + 1))):
        pass


def test_a_video_whose_name_is_no_utf8_is_refused():
    """OpenCV 5.0 ends the process by SIGSEGV."""
    with pytest.raises(InputError, match="no UTF-8"):
        name_for_ffmpeg(Path("a\udcff.avi"))
