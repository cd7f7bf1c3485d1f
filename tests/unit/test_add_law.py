# SPDX-License-Identifier: MIT
"""A constitutive model is one file and a preset: a toy model, dropped into a copy of the tree, bakes."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from physgen.sim.cache.pc2 import Pc2Reader

pytest.importorskip("taichi")

ROOT = Path(__file__).resolve().parents[2]

TOY = '''
"""Linear springs along the principal stretches: psi = mu sum (s - 1)^2, scaled by ``toy_factor``."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from .base import DeformableMaterial, DeviceFunctions, Parameter, principal_stretches


@dataclass(frozen=True, kw_only=True)
class ToyMaterial(DeformableMaterial):
    """A toy."""

    toy_factor: float = 1.0

    law: ClassVar[str] = "toy"
    reads: ClassVar[tuple[str, ...]] = (*DeformableMaterial.reads, "toy_factor")
    parameters: ClassVar[tuple[Parameter, ...]] = (Parameter("toy_factor", 1.0, 0.1, 10.0, "a factor"),)

    def own_numbers(self):
        return (self.toy_factor,)

    def elastic_energy(self, volumes, deformation, memories):
        stretches, _ = principal_stretches(deformation)
        return float(volumes @ (self.toy_factor * self.shear_modulus * ((stretches - 1) ** 2).sum(axis=1)))

    @staticmethod
    def device():
        import taichi as ti

        from .tensors import eigen_symmetric, isotropic

        @ti.func
        def stress(F, C, memory, two_mu, lam, own):
            squares, axes = eigen_symmetric(F @ F.transpose())
            s = ti.sqrt(ti.max(squares, 0.0))
            return isotropic(own[0] * two_mu * s * (s - 1.0), axes), own[0] * two_mu * squares.max() + lam, 0.0

        return DeviceFunctions(stress=stress)
'''

PRESET = """description = "A toy"
source = "All: chosen"
density = 1000.0
youngs_modulus = 2e4
poisson_ratio = 0.2
law = "toy"
toy_factor = 2.0
"""


BAKES = """
import json, sys
from pathlib import Path
from physgen.sim.app.bake import bake
from physgen.sim.app.bake_options import BakeOptions
from physgen.sim.app.reconstruct import Physics, with_physics
from physgen.sim.scene.folder import load_scene, save_scene

scene = load_scene(Path(sys.argv[1]))
for name, overrides in json.loads(sys.argv[3]).items():
    varied = save_scene(scene.root, with_physics(scene.model, Physics(overrides=tuple(overrides))))
    bake(varied, out=Path(sys.argv[2]) / name, options=BakeOptions(frames=8, quality="preview"))
"""
"""One process, which compiles once."""


@pytest.fixture
def tree(tmp_path):
    """The tree with one more file in sim/constitutive and one more preset; nothing else differs."""
    copy = tmp_path / "tree" / "physgen"
    for folder in ("sim", "batch", "physgen_addon", "presets"):
        shutil.copytree(ROOT / folder, copy / folder, ignore=shutil.ignore_patterns("__pycache__"))
    shutil.copy(ROOT / "__init__.py", copy)
    (copy / "sim" / "constitutive" / "toy.py").write_text(TOY)
    (copy / "presets" / "materials" / "toy.toml").write_text(PRESET)
    return copy.parent


@pytest.mark.long
def test_a_model_is_one_file_and_a_preset(tree, ball_scene, tmp_path):
    folder = ball_scene(preset="jelly", velocity=(0.0, 0.0, -1.0))
    variants = {"toy": ["ball0.preset=toy"], "stiffer": ["ball0.preset=toy", "ball0.toy_factor=8"]}
    result = subprocess.run(
        [sys.executable, "-c", BAKES, str(folder.root), str(tmp_path), json.dumps(variants)],
        env={**os.environ, "PYTHONPATH": str(tree)},
        capture_output=True,
        text=True,
    )
    assert result.returncode == 0, result.stderr
    bakes = {}
    for name in variants:
        cache = Pc2Reader(tmp_path / name / "ball0.pc2")
        bakes[name] = np.stack([cache.sample(i) for i in range(cache.sample_count)])
    heights = {name: frames[..., 2] for name, frames in bakes.items()}
    assert all(np.isfinite(frames).all() for frames in bakes.values())
    flattest = {name: np.ptp(height, axis=1).min() for name, height in heights.items()}
    assert flattest["toy"] < 0.97 * flattest["stiffer"]
