# SPDX-License-Identifier: MIT
"""Programs that make meshes of pictures, each run as its authors publish it.

Their weights and GPUs cannot be had here. Each stand-in is a folder with modules, names, signatures and output files as
the program's own example has them (versions below); the shipped command files and drivers run for real, in an
interpreter of its own.
"""

import json
import os
import sys

import numpy as np
import pytest
from physgen.sim.errors import InputError
from physgen.sim.reconstruct.adapters import resolve
from physgen.sim.reconstruct.adapters.adapter_registry import PROGRAM_PYTHON, PROGRAMS, list_adapters
from physgen.sim.scene.meshes import read_mesh

PIXELS = np.random.default_rng(0).integers(0, 255, (60, 80, 3), dtype=np.uint8)
MASK = np.zeros((60, 80), dtype=bool)
MASK[20:45, 30:60] = True

pytestmark = pytest.mark.skipif(os.name == "nt", reason="the stand-ins' interpreter is a link")

CUBE = """
import json, trimesh
def cube(extent):
    return trimesh.creation.box(extents=(extent, extent, 2 * extent))
def note(**words):
    json.dump(words, open("said.json", "w"))
"""
# TripoSG at 8866ef2: scripts/inference_triposg.py; its flags, and one mesh at --output-path.
TRIPOSG = {
    "scripts/__init__.py": "",
    "scripts/cube.py": CUBE,
    "scripts/inference_triposg.py": """
import argparse, os
from PIL import Image
from .cube import cube, note
parser = argparse.ArgumentParser()
parser.add_argument("--image-input", required=True)
parser.add_argument("--output-path", default="./output.glb")
parser.add_argument("--seed", type=int, default=42)
options = parser.parse_args()
image = Image.open(options.image_input)
note(mode=image.mode, size=image.size, offline=os.environ.get("HF_HUB_OFFLINE"))
cube(1.0).export(options.output_path)
""",
}
# TRELLIS: example.py in its README; sample.glb and sample.ply, whose splats are no mesh.
TRELLIS = {
    "trellis/__init__.py": "",
    "trellis/cube.py": CUBE,
    "trellis/pipelines.py": """
from pathlib import Path
from .cube import note
class Gaussian:
    def save_ply(self, path):
        Path(path).write_text("ply splats, no faces")
class TrellisImageTo3DPipeline:
    @staticmethod
    def from_pretrained(name):
        return TrellisImageTo3DPipeline()
    def cuda(self):
        pass
    def run(self, image, num_samples=1, seed=42, sparse_structure_sampler_params={}, slat_sampler_params={},
            formats=["mesh", "gaussian", "radiance_field"], preprocess_image=True):
        note(mode=image.mode, size=image.size)
        return {"gaussian": [Gaussian()], "mesh": ["mesh"], "radiance_field": []}
""",
    "trellis/utils/__init__.py": "",
    "trellis/utils/postprocessing_utils.py": """
from ..cube import cube
def to_glb(app_rep, mesh, simplify=0.95, fill_holes=True, fill_holes_max_size=0.04, texture_size=1024, debug=False,
           verbose=True):
    assert mesh == "mesh" and hasattr(app_rep, "save_ply")
    return cube(1.0)
""",
}
# Hunyuan3D 2.1 at 537672f: demo.py; and version 2, whose module is another.
HUNYUAN_PIPELINE = """
from .cube import cube, note
class Hunyuan3DDiTFlowMatchingPipeline:
    @classmethod
    def from_pretrained(cls, model_path, **kwargs):
        cls.path = model_path
        return cls()
    def __call__(self, image=None, num_inference_steps=50, **kwargs):
        note(mode=image.mode, size=image.size, path=self.path)
        return [cube(1.0)]
"""
HUNYUAN_21 = {
    "hy3dshape/hy3dshape/__init__.py": "",
    "hy3dshape/hy3dshape/cube.py": CUBE,
    "hy3dshape/hy3dshape/pipelines.py": HUNYUAN_PIPELINE,
}
HUNYUAN_2 = {
    "hy3dgen/__init__.py": "",
    "hy3dgen/shapegen/__init__.py": "from .pipelines import Hunyuan3DDiTFlowMatchingPipeline",
    "hy3dgen/shapegen/cube.py": CUBE,
    "hy3dgen/shapegen/pipelines.py": HUNYUAN_PIPELINE,
}
# SAM 3D Objects at 0519b50: notebook/inference.py as demo.py calls it; mesh.glb and splat.ply.
SAM_3D = {
    "notebook/cube.py": CUBE,
    "notebook/inference.py": """
from pathlib import Path
import numpy as np
from cube import cube, note
class Splats:
    def save_ply(self, path):
        Path(path).write_text("ply splats, no faces")
class Inference:
    def __init__(self, config_file, compile=False):
        assert config_file == "checkpoints/hf/pipeline.yaml"
    def __call__(self, image, mask, seed=None, pointmap=None, **kwargs):
        assert image.dtype == np.uint8 and mask.dtype == bool and image.shape[:2] == mask.shape
        note(share=float(mask.mean()), size=image.shape[1::-1])
        return {"gs": Splats(), "glb": cube(1.0) if mask.any() else None}
""",
}
STAND_INS = {
    "triposg": ("triposg", TRIPOSG),
    "trellis": ("trellis", TRELLIS),
    "hunyuan3d 2.1": ("hunyuan3d", HUNYUAN_21),
    "hunyuan3d 2": ("hunyuan3d", HUNYUAN_2),
    "sam-3d-objects": ("sam-3d-objects", SAM_3D),
}


def program(tmp_path, files):
    """A folder as the program's clone, with an environment whose interpreter is this one."""
    folder = tmp_path / "the program"
    for name, text in files.items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    (folder / ".venv" / "bin").mkdir(parents=True)
    python = folder / ".venv" / "bin" / "python"
    # A script rather than a link, so that the interpreter finds this environment's packages.
    python.write_text(f'#!/bin/sh\nexec {sys.executable!r} "$@"\n')
    python.chmod(0o755)
    return folder


@pytest.mark.parametrize("name", STAND_INS)
def test_its_mesh_is_found_in_its_published_layout(tmp_path, name):
    kind, files = STAND_INS[name]
    folder, out = program(tmp_path, files), tmp_path / "out"
    out.mkdir()
    mesh = resolve("mesher", f"{kind}:{folder}")(PIXELS, MASK, out)
    assert np.allclose(sorted(read_mesh(mesh).extents), (1.0, 1.0, 2.0))
    said = json.loads((folder / "said.json").read_text())
    if kind == "sam-3d-objects":
        # It sees the photo, and where the object is.
        assert said["size"] == [80, 60] and said["share"] == pytest.approx(MASK.mean())
    else:
        assert said["mode"] == "RGBA" and said["size"][0] == said["size"][1]
    if kind == "triposg":
        assert said["offline"] == "1"


def test_every_program_has_one():
    assert {kind for kind, _ in STAND_INS.values()} == set(PROGRAMS)


def test_a_program_that_is_not_there_or_has_no_python_is_told(tmp_path, monkeypatch):
    with pytest.raises(InputError, match="there is no folder"):
        resolve("mesher", f"trellis:{tmp_path / 'none'}")
    with pytest.raises(InputError, match=PROGRAM_PYTHON):
        resolve("mesher", f"trellis:{tmp_path}")
    monkeypatch.setenv(PROGRAM_PYTHON, sys.executable)
    out = tmp_path / "out"
    out.mkdir()
    with pytest.raises(InputError, match="trellis"):
        # It starts, and the program's modules are not in this folder.
        resolve("mesher", f"trellis:{tmp_path}")(PIXELS, MASK, out)
    with pytest.raises(InputError, match="is a mesher, not a segmenter"):
        resolve("segmenter", f"trellis:{tmp_path}")


def test_a_layout_that_changed_is_told_with_what_is_there(tmp_path):
    changed = {**TRIPOSG}
    changed["scripts/inference_triposg.py"] = TRIPOSG["scripts/inference_triposg.py"].replace(
        "options.output_path)", "options.output_path.replace('mesh.glb', 'result.glb'))"
    )
    folder, out = program(tmp_path, changed), tmp_path / "out"
    out.mkdir()
    with pytest.raises(InputError, match=r"wrote no mesh\.glb; there is result\.glb"):
        resolve("mesher", f"triposg:{folder}")(PIXELS, MASK, out)
    assert not list(out.iterdir())


@pytest.mark.parametrize(
    "results", ['["../mesh.glb"]', '["/mesh.glb"]', '["mesh.txt"]', "[]", '"mesh.glb"', '["a/../../mesh.glb"]']
)
def test_results_cannot_leave_their_folder(tmp_path, results):
    path = tmp_path / "mine.toml"
    path.write_text(
        f'stage = "mesher"\ncommand = ["x", "{{input}}", "{{output}}"]\noutput = "made"\nresults = {results}\n'
    )
    with pytest.raises(InputError, match="results is"):
        resolve("mesher", f"command:{path}")


def test_a_program_may_have_a_name(tmp_path, monkeypatch):
    folder = program(tmp_path, TRIPOSG)
    names = tmp_path / "names.toml"
    names.write_text(f'[mesher]\nmine = "triposg:{folder}"\ngone = "trellis:nowhere"\n')
    monkeypatch.setenv("PHYSGEN_ADAPTERS", str(names))
    found = {item.name: item.usable for item in list_adapters() if item.stage == "mesher"}
    assert found == {"mine": True, "gone": False}
