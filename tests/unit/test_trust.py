# SPDX-License-Identifier: MIT
"""A folder from a stranger runs nothing and reads nothing beside itself, until the user agreed."""

import dataclasses
import json
import os
import re
import shutil
import stat
import sys
import typing
from pathlib import Path

import numpy as np
import pytest
from physgen.batch.cli import main
from physgen.batch.commands import install_commands
from physgen.sim import trust
from physgen.sim.app import reconstruct_record
from physgen.sim.app.reconstruct import correct, reconstruct
from physgen.sim.app.reconstruct_record import read_stamp, require_request
from physgen.sim.errors import InputError
from physgen.sim.reconstruct import ObjectRequest, ReconstructOptions
from physgen.sim.reconstruct.adapters.protocols import STAGES
from physgen.sim.reconstruct.adapters.resolve import resolve
from physgen.sim.scene.folder import load_scene
from physgen.sim.scene.scene_output import STAMP_FILE
from physgen.sim.trust import NotTrusted, UntrustedSpec, trusted_spec
from physgen.sim.validation import parse
from PIL import Image

QUICK = ReconstructOptions(mesh_vertices=500, pitch_deg=25.0, patch_radius=2, sun=False, max_size=96)
PROGRAM = """
from pathlib import Path
Path(__file__).with_name("ran").touch()
def stage(*arguments):
    raise SystemExit("ran")
"""


@pytest.fixture(scope="module", autouse=True)
def quick_backgrounds(without_trials):
    with without_trials():
        yield


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A scene that a stranger made, with its photo inside; and the list of what they agreed to is not ours."""
    folder = tmp_path_factory.mktemp("downloaded")
    rng = np.random.default_rng(2)
    image = np.full((72, 96, 3), (190.0, 175, 140)) + rng.normal(scale=4, size=(72, 96, 1))
    rows, columns = np.mgrid[:72, :96] + 0.5
    image[(columns - 48) ** 2 + (rows - 38) ** 2 < 15**2] = (200, 50, 40)
    Image.fromarray(np.clip(image, 0, 255).astype(np.uint8)).save(folder / "photo.png")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PHYSGEN_CONFIG", str(folder / "theirs"))
        requests = [ObjectRequest(box=(30, 18, 66, 58), name="ball", shape="inflated")]
        reconstruct(folder / "photo.png", requests, out=folder / "scene", options=QUICK)
    return folder


@pytest.fixture
def scene(made, tmp_path, monkeypatch):
    """A copy of it, whose record names nothing outside; this user has agreed to nothing."""
    shutil.copytree(made / "scene", tmp_path / "scene")
    monkeypatch.setenv("PHYSGEN_CONFIG", str(tmp_path / "config"))
    monkeypatch.chdir(tmp_path)
    change(tmp_path / "scene", lambda record: record.update(photo=str(tmp_path / "scene" / "photo.png")))
    return tmp_path / "scene"


def change(scene, edit):
    path = scene / STAMP_FILE
    record = json.loads(path.read_text(encoding="utf-8"))
    edit(record)
    path.write_text(json.dumps(record), encoding="utf-8")


def hostile_specs(scene):
    """Specifications by name that would start something, all within the downloaded folder."""
    stages = scene / "stages"
    (stages / "x.py").write_text(PROGRAM)
    (stages / "__init__.py").touch()
    command = stages / "x.toml"
    program = [sys.executable, "{here}/x.py", "{input}", "{output}"]
    for stage in STAGES:
        first = "{photo}" if stage == "mesher" else "{input}"
        content = f"stage = {stage!r}\ncommand = {[*program[:2], first, '{output}']!r}\n"
        (stages / f"{stage}.toml").write_text(content)
    command.write_text(f"stage = 'segmenter'\ncommand = {program!r}\n")
    home = stages / "triposg"
    (home / "venv" / "bin").mkdir(parents=True)
    (home / "venv" / "bin" / "python").write_text(f"#!/bin/sh\ntouch {stages}/ran\n")
    (home / "venv" / "bin" / "python").chmod(0o755)
    return stages


@pytest.mark.parametrize("stage", STAGES)
@pytest.mark.parametrize("kind", ["file", "module", "command", "name", "program", "model"])
def test_an_adapter_of_a_downloaded_scene_does_not_run(scene, capsys, stage, kind):
    if kind == "program" and stage != "mesher":
        pytest.skip("programs make meshes")
    stages = hostile_specs(scene)
    spec = {
        "file": f"python:{stages}/x.py:stage",
        "module": "python:scene.stages.x:stage",
        "command": f"command:{stages}/{stage}.toml",
        "name": "theirs",
        "program": f"triposg:{stages}/triposg",
        "model": f"lama:{stages}/x.onnx",
    }[kind]
    change(scene, lambda record: record["options"].update({stage: spec}))
    sys.path.insert(0, str(Path.cwd()))
    try:
        before = (scene / "scene.json").read_bytes()
        assert main(["correct", str(scene), "--size", "ball=0.3", "--no-sun"]) == 3
    finally:
        sys.path.remove(str(Path.cwd()))
    said = capsys.readouterr().err
    assert f"options.{stage} = " in said and "--trust" in said
    assert spec.partition(":")[0] in said
    assert not (stages / "ran").exists() and (scene / "scene.json").read_bytes() == before
    # A value of the user's own takes the place of the stranger's.
    if stage == "segmenter":
        assert not read_stamp(scene).request.claims({"options.segmenter": "none"})


def test_after_the_users_word_it_runs_and_every_line_was_shown_first(scene, capsys):
    stages = hostile_specs(scene)
    spec = f"python:{stages}/x.py:stage"
    change(scene, lambda record: record["options"].update(segmenter=spec))
    assert main(["correct", str(scene), "--size", "ball=0.3", "--trust"]) == 3
    said = capsys.readouterr()
    assert "failed with SystemExit" in said.err and (stages / "ran").exists()
    assert f"runs  options.segmenter = {spec}" in said.out
    # Agreed to once, it needs no second word, until its code changes: a file beside it counts.
    require_request(load_scene(scene))
    (stages / "helper.py").write_text("other = 1")
    with pytest.raises(NotTrusted, match="segmenter"):
        require_request(load_scene(scene))


@pytest.mark.parametrize(
    ("field", "edit"),
    [
        ("photo", lambda record, path: record.update(photo=path)),
        ("objects.ball.mask", lambda record, path: record["objects"][0].update(mask=path)),
        ("objects.ball.mesh", lambda record, path: record["objects"][0].update(mesh=path)),
        ("options.depth", lambda record, path: record["options"].update(depth=path)),
        ("options.environment", lambda record, path: record["options"].update(environment=path)),
    ],
)
@pytest.mark.parametrize("way", ["absolute", "up", "link"])
def test_a_file_outside_the_folder_is_not_read(scene, tmp_path, capsys, field, edit, way):
    secret = tmp_path / "private.png"
    Image.new("RGB", (96, 72)).save(secret)
    name = {"absolute": str(secret), "up": "scene/../private.png", "link": str(scene / "stages" / "inside.png")}[way]
    if way == "link":
        (scene / "stages" / "inside.png").symlink_to(secret)
    change(scene, lambda record: edit(record, name))
    assert main(["correct", str(scene), "--size", "ball=0.3"]) == 3
    assert f"reads {field} = " in capsys.readouterr().err


def test_a_record_has_no_field_that_nobody_asks_about():
    """Every path and every adapter of a request is a claim: a new field cannot be forgotten."""
    for kind in (ReconstructOptions, ObjectRequest, reconstruct_record.Request):
        for field, hint in typing.get_type_hints(kind).items():
            parts = set(typing.get_args(hint)) or {hint}
            if UntrustedSpec in parts:
                assert field in STAGES
            assert not (Path in parts and not isinstance(hint, type) and len(parts - {Path, type(None)})), field
    assert {f.name for f in dataclasses.fields(ReconstructOptions)} >= set(STAGES)


def test_what_came_from_json_cannot_be_started():
    """By design, not by a check in one command: the parser makes it of another type than what starts adapters."""
    options = parse(ReconstructOptions, {"mesher": "python:os:system", "segmenter": "none"}, "x")
    for stage in ("mesher", "segmenter"):
        spec = getattr(options, stage)
        assert isinstance(spec, UntrustedSpec) and not isinstance(spec, str)
        with pytest.raises(NotTrusted):
            trusted_spec(spec)
        with pytest.raises(NotTrusted):
            resolve(stage, spec)
        with pytest.raises(TypeError):
            json.dumps(spec)


def test_a_scene_of_ones_own_needs_no_word(made, tmp_path, monkeypatch):
    monkeypatch.setenv("PHYSGEN_CONFIG", str(tmp_path / "config"))
    requests = [ObjectRequest(box=(30, 18, 66, 58), name="ball", shape="inflated")]
    own = reconstruct(made / "photo.png", requests, out=tmp_path / "own", options=QUICK)
    earlier = require_request(own)
    assert earlier.photo == made / "photo.png"
    again = correct(own, earlier=earlier, objects=earlier.objects, options=earlier.options)
    # Moved, it is still the same; for another user it is a stranger's.
    again.root.rename(tmp_path / "moved")
    require_request(load_scene(tmp_path / "moved"))
    monkeypatch.setenv("PHYSGEN_CONFIG", str(tmp_path / "other"))
    with pytest.raises(NotTrusted, match="reads photo"):
        require_request(load_scene(tmp_path / "moved"))


@pytest.mark.skipif(os.name == "nt", reason="permissions of POSIX")
def test_the_list_is_the_users_alone(tmp_path, monkeypatch):
    monkeypatch.setenv("PHYSGEN_CONFIG", str(tmp_path / "config"))
    trust.remember("a" * 64, tmp_path / "scene")
    path = tmp_path / "config" / trust.LIST_FILE
    assert stat.S_IMODE(path.stat().st_mode) == 0o600 and stat.S_IMODE(path.parent.stat().st_mode) == 0o700
    assert trust.trusted_keys() == {"a" * 64}
    # What others may write is not the user's word.
    path.chmod(0o666)
    assert trust.trusted_keys() == frozenset()


@pytest.mark.parametrize(
    "content", ["", "[]", "null", '{"format": "physgen-trust/1"}', '{"format": 1, "folders": [3]}']
)
def test_a_damaged_list_counts_as_empty(tmp_path, monkeypatch, content):
    monkeypatch.setenv("PHYSGEN_CONFIG", str(tmp_path))
    (tmp_path / trust.LIST_FILE).write_text(content)
    (tmp_path / trust.LIST_FILE).chmod(0o600)
    assert trust.trusted_keys() == frozenset()
    trust.remember("b" * 64, tmp_path)
    assert trust.trusted_keys() == {"b" * 64}


def test_a_line_cannot_forge_another_one():
    claim = trust.Claim(trust.RUNS, "options.mesher", "python:x.py:f\n  reads photo = nothing\x1b[2K\u202e")
    assert len(claim.line().splitlines()) == 1 and claim.line().isprintable()


def test_no_code_beside_what_is_hashed_is_missed(tmp_path):
    (tmp_path / "deep").mkdir()
    (tmp_path / "x.py").write_text("a")
    before = trust.code_hash([tmp_path])
    (tmp_path / "deep" / "y.py").write_text("b")
    after = trust.code_hash([tmp_path])
    assert before != after == trust.code_hash([tmp_path])
    for number in range(trust.MOST_CODE_FILES):
        (tmp_path / "deep" / f"{number}.py").touch()
    assert trust.code_hash([tmp_path]) != trust.code_hash([tmp_path])


@pytest.mark.skipif(os.name == "nt", reason="links need a privilege there")
def test_code_behind_a_link_counts_as_code(tmp_path):
    """What is imported through a link could be changed after the user's word, and ran without another."""
    (tmp_path / "code").mkdir()
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "data.bin").write_text("a")
    (tmp_path / "elsewhere" / "deep.py").write_text("a")
    (tmp_path / "code" / "x.py").symlink_to(tmp_path / "data.bin")
    (tmp_path / "code" / "package").symlink_to(tmp_path / "elsewhere")
    (tmp_path / "elsewhere" / "around").symlink_to(tmp_path / "code")
    found = [trust.code_hash([tmp_path / "code"])]
    assert found[0] == trust.code_hash([tmp_path / "code"])
    for path in (tmp_path / "data.bin", tmp_path / "elsewhere" / "deep.py"):
        path.write_text("b")
        found.append(trust.code_hash([tmp_path / "code"]))
    assert len(set(found)) == 3


def test_too_much_to_look_at_is_asked_about_every_time(tmp_path, monkeypatch):
    (tmp_path / "x.py").write_text("a")
    monkeypatch.setattr(trust, "MOST_LOOKED_AT", 4)
    assert trust.code_hash([tmp_path]) == trust.code_hash([tmp_path])
    for number in range(5):
        (tmp_path / f"{number}.txt").touch()
    assert trust.code_hash([tmp_path]) != trust.code_hash([tmp_path])


def test_nothing_outside_is_looked_at_before_the_users_word(scene, tmp_path):
    """On Windows a look at \\\\host\\share tells the host who looks; nor is a folder of the network mounted."""
    looked = []

    def hear(event, given):
        if watching and event in ("open", "os.listdir", "os.scandir"):
            looked.append(os.fsdecode(given[0]) if isinstance(given[0], str | bytes) else "")

    private = tmp_path / "private" / "photo.png"
    change(scene, lambda record: record.update(photo=str(private)))
    stamp = read_stamp(scene)
    lstat = os.lstat

    def noted(path, **more):
        looked.append(os.fsdecode(path))
        return lstat(path, **more)

    watching = True
    sys.addaudithook(hear)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(os, "lstat", noted)
        patch.setattr(os.path, "lexists", lambda path: bool(noted(path)))
        claims = stamp.request.claims()
    watching = False
    assert [claim.text for claim in claims] == [str(private)]
    assert looked and not [path for path in looked if "private" in path]


def test_the_error_names_the_remedy(scene):
    change(scene, lambda record: record["options"].update(mesher="python:os:system"))
    with pytest.raises(InputError, match=r"you have not agreed to it:\n  runs  options\.mesher = python:os:system"):
        require_request(load_scene(scene))


def test_the_threat_model_names_tests_that_are_there():
    root = Path(__file__).parents[2]
    named = set(re.findall(r"`(test_\w+\.py)`", (root / "docs" / "security.md").read_text(encoding="utf-8")))
    there = {path.name for path in (root / "tests").rglob("test_*.py")}
    assert len(named) >= 10 and named <= there, named - there


@pytest.fixture
def hostile_place(tmp_path, monkeypatch):
    """A working folder with a module that is called as one that is imported; the file that it writes when it runs."""
    (tmp_path / "colorsys.py").write_text(f"open({str(tmp_path / 'ran')!r}, 'w')\n")
    monkeypatch.chdir(tmp_path)
    return tmp_path / "ran"


def test_the_examination_of_an_installation_imports_nothing_from_the_working_folder(hostile_place):
    found = install_commands._import("colorsys", "import colorsys; print(colorsys.__file__)", "install it")
    assert found[1] and "colorsys" in found[2] and not hostile_place.exists()


def test_programs_that_are_started_import_nothing_from_the_working_folder():
    """Farms start Python in the job's folder, which may have come from anybody; -P and -I leave it out."""
    tree = Path(__file__).parents[2]
    files = [path for folder in ("sim", "batch", "physgen_addon") for path in (tree / folder).rglob("*.[pj][ys]")]
    assert len(files) > 300
    starts = {
        path.name: line.strip()
        for path in files
        for line in path.read_text(encoding="utf-8").splitlines()
        if re.search(r'"-[cm]"', line) and not re.search(r'"-[IP]"', line)
    }
    # It works in a temporary folder of its own.
    assert starts == {
        "render_engines.py": 'start = [bpy.app.binary_path, *compat.HEADLESS, "--python-expr"] '
        'if bpy.app.binary_path else [sys.executable, "-c"]'
    }
