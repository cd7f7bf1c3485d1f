# SPDX-License-Identifier: MIT
"""A user's own functions in place of stages, names for them, and what doctor says of both."""

import importlib.metadata
import json
import os
import subprocess
import sys

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as npst
from physgen.batch.commands.install_commands import adapter_findings
from physgen.sim.errors import InputError
from physgen.sim.reconstruct.adapters import Depth, object_crop, resolve
from physgen.sim.reconstruct.adapters.adapter_registry import spec_files
from physgen.sim.reconstruct.adapters.protocols import checked_depth, checked_masks
from PIL import Image

WIDTH, HEIGHT = 24, 16
PIXELS = np.random.default_rng(1).integers(0, 255, (HEIGHT, WIDTH, 3), dtype=np.uint8)
HOLE = np.zeros((HEIGHT, WIDTH), dtype=bool)
HOLE[4:9, 5:15] = True
BOXES = np.array([[1.0, 1, 9, 9], [10, 2, 20, 12]])

MODULE = """
import sys
import numpy as np

def segment(pixels, boxes):
    masks = []
    for a, b, c, d in boxes.astype(int):
        mask = np.zeros(pixels.shape[:2], np.uint8)
        mask[b:d, a:c] = 255
        masks.append(mask)
    return masks

def fill(pixels, hole):
    pixels[hole] = 77
    return pixels

def depth(pixels, *, model="big"):
    return {"depth": np.arange(pixels[..., 0].size).reshape(pixels.shape[:2]) + 1, "meaning": "inverse"}

def mesh(pixels, mask, folder):
    path = folder / "it.ply"
    path.write_text(
        "ply\\nformat ascii 1.0\\n"
        "element vertex 3\\nproperty float x\\nproperty float y\\nproperty float z\\n"
        "element face 1\\nproperty list uchar int vertex_indices\\nend_header\\n0 0 0\\n1 0 0\\n0 1 0\\n3 0 1 2\\n")
    return str(path)

def breaks(pixels, hole):
    return {}["weights"]

def leaves(pixels, hole):
    sys.exit("no GPU")

def wrong_size(pixels, hole):
    return pixels[1:]

def floats(pixels, hole):
    return pixels / 255

def nothing(pixels, hole):
    return None

def two(pixels):
    return pixels

class Model:
    def fill(self, pixels, hole):
        return pixels * 0

model = Model()
"""


@pytest.fixture
def module(tmp_path):
    path = tmp_path / "mine.py"
    path.write_text(MODULE)
    return path


def test_functions_of_a_file(module, tmp_path):
    masks = resolve("segmenter", f"python:{module}:segment")(PIXELS, BOXES)
    assert masks.shape == (2, HEIGHT, WIDTH) and masks.dtype == bool and masks[1, 2:12, 10:20].all()
    before = PIXELS.copy()
    filled = resolve("inpainter", f"python:{module}:fill")(PIXELS, HOLE)
    assert (filled[HOLE] == 77).all() and (filled[~HOLE] == PIXELS[~HOLE]).all()
    assert (before == PIXELS).all(), "what the caller has stays, whatever the function does to its own"
    assert (resolve("inpainter", f"python:{module}:model.fill")(PIXELS, HOLE)[HOLE] == 0).all()
    depth = resolve("depth_estimator", f"python:{module}:depth")(PIXELS)
    assert depth.meaning == "inverse" and depth.values[0, 3] == 4 and depth.focal_px is None
    path = resolve("mesher", f"python:{module}:mesh")(PIXELS, HOLE, tmp_path)
    assert len(trimesh.load(path).faces) == 1


def test_functions_of_an_installed_module(module, monkeypatch):
    monkeypatch.syspath_prepend(str(module.parent))
    assert (resolve("inpainter", "python:mine:fill")(PIXELS, HOLE)[HOLE] == 77).all()
    del sys.modules["mine"]


BAD = {
    "breaks": "failed with KeyError: 'weights'",
    "leaves": "failed with SystemExit: no GPU",
    "wrong_size": r"returned an array of \(15, 24, 3\)",
    "floats": "float64, expected",
    "nothing": "returned NoneType",
}


@pytest.mark.parametrize("name", BAD)
def test_mistakes_of_a_function_are_told_as_its_own(module, name):
    with pytest.raises(InputError, match=rf"adapter python:.*mine.py:{name}: .*{BAD[name]}"):
        resolve("inpainter", f"python:{module}:{name}")(PIXELS, HOLE)


@pytest.mark.parametrize(
    ("target", "words"),
    [
        ("{module}:two", r"cannot be called with \(pixels, hole\)"),
        ("{module}:Model", "no such function"),
        ("{module}:nope", "no such function"),
        ("{module}:model.nope.deeper", "no such function"),
        ("{module}", "give python:MODULE:FUNCTION"),
        ("/nowhere/x.py:fill", "no file /nowhere/x.py"),
        ("no_such_module_anywhere:fill", "cannot be imported.*no_such_module_anywhere"),
        ("", "has no target"),
    ],
)
def test_unsuitable_functions_are_refused_at_once(module, target, words):
    with pytest.raises(InputError, match=words):
        resolve("inpainter", f"python:{target.format(module=module)}")


@pytest.mark.parametrize("content", ["def (", "import no_such_thing", "raise SystemExit('bye')", "\0"])
def test_a_file_that_cannot_be_run(tmp_path, content):
    (tmp_path / "x.py").write_text(content)
    with pytest.raises(InputError, match=r"x\.py"):
        resolve("inpainter", f"python:{tmp_path / 'x.py'}:fill")


def test_names_from_a_file(module, tmp_path, monkeypatch):
    Image.fromarray(np.full((2 * HEIGHT + 32, 2 * WIDTH + 48, 3), 40, np.uint8)).save(tmp_path / "clean.png")
    (tmp_path / "adapters.toml").write_text(
        '[inpainter]\nmine = "python:mine.py:fill"\nclean = "picture:clean.png"\ngone = "command:gone.toml"\n'
        'big = "lama:gone.onnx"\n[depth_estimator]\nmine = "python:no_such_module:f"\n'
    )
    monkeypatch.setenv("PHYSGEN_ADAPTERS", str(tmp_path / "adapters.toml"))
    assert (resolve("inpainter", "mine")(PIXELS, HOLE)[HOLE] == 77).all()
    assert (resolve("inpainter", "clean")(PIXELS, HOLE)[HOLE] == 40).all()
    with pytest.raises(InputError, match=r"no adapter of that name \(known: mine, clean, gone, big"):
        resolve("inpainter", "other")
    with pytest.raises(InputError, match=r"known: none"):
        resolve("segmenter", "mine")
    table = tmp_path / "adapters.toml"
    assert spec_files("inpainter", "clean") == [table, tmp_path / "clean.png"]
    assert spec_files("inpainter", "gone") == [table] and spec_files("inpainter", f"python:{module}:fill") == [module]
    assert spec_files("inpainter", "python:json:dumps") == []
    monkeypatch.delenv("PHYSGEN_ADAPTERS")
    with pytest.raises(InputError, match="known: none"):
        resolve("inpainter", "mine")
    assert (resolve("inpainter", "mine", names=table)(PIXELS, HOLE)[HOLE] == 77).all()
    monkeypatch.setenv("PHYSGEN_ADAPTERS", str(table))
    found = {name: (ok, text) for name, ok, text in adapter_findings()}
    assert found["inpainter mine"][0] and found["inpainter clean"][0]
    assert not found["inpainter gone"][0] and "no such file" in found["inpainter gone"][1]
    assert not found["inpainter big"][0] and "no such file" in found["inpainter big"][1]
    assert not found["depth_estimator mine"][0] and "not installed here" in found["depth_estimator mine"][1]
    (tmp_path / "adapters.toml").write_text('[inpainter]\nx = "nonsense"\n')
    (bad,) = (f for f in adapter_findings() if not f[1])
    assert "inpainter.x: expected" in bad[2]
    with pytest.raises(InputError, match=r"inpainter\.x"):
        resolve("inpainter", "x")


def test_names_of_an_installed_package(module, tmp_path):
    info = tmp_path / "theirs-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: theirs\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text("[physgen.adapters]\ninpainter.theirs = mine:fill\nnonsense = mine:fill\n")
    code = (
        "import json, numpy as np; from physgen.sim.reconstruct.adapters import resolve\n"
        "from physgen.sim.reconstruct.adapters.adapter_registry import list_adapters\n"
        "f = resolve('inpainter', 'theirs')(np.zeros((4, 4, 3), np.uint8), np.eye(4, dtype=bool))\n"
        "print(json.dumps([f.tolist(), [(a.stage, a.name, a.usable) for a in list_adapters()]]))"
    )
    path = os.pathsep.join([str(tmp_path), *(p for p in sys.path if p)])
    result = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, env={**os.environ, "PYTHONPATH": path}
    )
    filled, found = json.loads(result.stdout)
    assert np.array(filled)[1, 1].tolist() == [77] * 3 and ["inpainter", "theirs", True] in found


def test_doctor_looks_and_runs_nothing(tmp_path, monkeypatch):
    (tmp_path / "evil.py").write_text(f"open({str(tmp_path / 'ran')!r}, 'w')\ndef fill(pixels, hole): pass\n")
    (tmp_path / "run.toml").write_text("stage = 'inpainter'\ncommand = ['/nowhere/x', '{input}', '{output}']")
    (tmp_path / "a.toml").write_text('[inpainter]\nevil = "python:evil.py:fill"\nrun = "command:run.toml"\n')
    monkeypatch.setenv("PHYSGEN_ADAPTERS", str(tmp_path / "a.toml"))
    found = {name: (ok, text) for name, ok, text in adapter_findings()}
    assert found["inpainter evil"][0] and not (tmp_path / "ran").exists()
    assert not found["inpainter run"][0] and "no program /nowhere/x" in found["inpainter run"][1]
    monkeypatch.delenv("PHYSGEN_ADAPTERS")
    if not importlib.metadata.entry_points(group="physgen.adapters"):
        assert any(name == "adapters (optional)" and ok for name, ok, _ in adapter_findings())


def test_a_picture_of_other_proportions_is_refused(tmp_path):
    Image.fromarray(np.zeros((64, 64, 3), np.uint8)).save(tmp_path / "p.png")
    with pytest.raises(InputError, match="64x64 pixels, the photo 24x16"):
        resolve("inpainter", f"picture:{tmp_path / 'p.png'}")(PIXELS, HOLE)
    with pytest.raises(InputError, match="not a depth_estimator"):
        resolve("depth_estimator", f"picture:{tmp_path / 'p.png'}")
    with pytest.raises(InputError, match="no such photo"):
        resolve("inpainter", f"picture:{tmp_path / 'q.png'}")
    with pytest.raises(InputError, match="stage 'painter'"):
        resolve("painter", "x")


def test_a_mesh_must_lie_in_its_folder(module, tmp_path):
    inner = tmp_path / "inner"
    inner.mkdir()
    module.write_text(MODULE + "\ndef out(pixels, mask, folder): return folder.parent / 'x.ply'\n")
    with pytest.raises(InputError, match="outside of the folder"):
        resolve("mesher", f"python:{module}:out")(PIXELS, HOLE, inner)


def test_the_crop_of_an_object_holds_all_of_it_and_nothing_else():
    crop = object_crop(PIXELS, HOLE)
    assert crop.shape[0] == crop.shape[1] and crop.shape[2] == 4
    alpha = crop[..., 3] == 255
    assert alpha.sum() == HOLE.sum() and (crop[alpha][:, :3] == PIXELS[HOLE]).all() and (crop[~alpha] == 0).all()
    rows, columns = np.flatnonzero(alpha.any(axis=1)), np.flatnonzero(alpha.any(axis=0))
    borders = [rows[0], columns[0], len(crop) - 1 - rows[-1], len(crop) - 1 - columns[-1]]
    assert min(borders) >= 1 and abs(borders[0] - borders[2]) <= 1 and abs(borders[1] - borders[3]) <= 1
    with pytest.raises(InputError, match="empty"):
        object_crop(PIXELS, ~np.ones_like(HOLE))


anything = st.one_of(
    st.none(),
    st.text(max_size=3),
    st.lists(st.floats(), max_size=3),
    st.builds(object),
    npst.arrays(
        st.sampled_from([np.float32, np.uint8, np.bool_, np.complex64, np.int64]),
        st.sampled_from([(3, 4), (1, 3, 4), (3, 4, 1), (2, 3, 4), (0,), ()]),
    ),
)


@settings(max_examples=200, deadline=None)
@given(anything)
def test_any_answer_is_refused_or_usable(value):
    try:
        masks = checked_masks(value, (3, 4), 1, "x")
    except InputError:
        pass
    else:
        assert masks.shape == (1, 3, 4) and masks.dtype == bool and masks.any()
    for wrapped in (value, {"depth": value, "focal_px": value}):
        try:
            depth = checked_depth(wrapped, (3, 4), "relative", "x")
        except InputError:
            continue
        known = depth.values[~np.isnan(depth.values)]
        assert isinstance(depth, Depth) and (known > 0).all() and np.isfinite(known).all() and known.size
