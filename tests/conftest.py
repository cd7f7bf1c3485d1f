# SPDX-License-Identifier: MIT
"""Small scenes that tests build from scratch."""

from __future__ import annotations

import atexit
import contextlib
import os
import shutil
import sys
import tempfile
from pathlib import Path

# What a user of this machine has installed must not change what tests see.
os.environ["PHYSGEN_MODELS"] = str(Path(__file__).with_name("no_models"))
# Nor do tests agree to anything in the user's name.
os.environ["PHYSGEN_CONFIG"] = tempfile.mkdtemp(prefix="physgen-tests-")
# Workers share the cores: threads of OpenBLAS that wait for one another took 40 % of a reconstruction's time. Children
# inherit it. It has to be set before NumPy is there.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import cv2
import numpy as np
import pytest
import trimesh
from hypothesis import settings
from physgen.sim.cache.bake_folder import BakedObject, BakeManifest
from physgen.sim.reconstruct.background import background_inpainting
from physgen.sim.reconstruct.background.method_choice import MethodChoice
from physgen.sim.scene.folder import Scene, save_scene
from physgen.sim.scene.material import load_preset
from physgen.sim.scene.model import Camera, SceneModel, SceneObject

atexit.register(shutil.rmtree, os.environ["PHYSGEN_CONFIG"], ignore_errors=True)

# Every run draws the same examples, so that none fails for what it did not touch; `make test-explore` draws new ones.
settings.register_profile("ci", derandomize=True, deadline=None)
settings.register_profile("explore", derandomize=False, deadline=None, print_blob=True)
settings.load_profile(os.environ.get("HYPOTHESIS_PROFILE", "ci"))

LONGEST = (
    "test_whole_job.py",
    "test_public_api.py",
    "test_bake.py",
    "test_reconstruct_pipeline.py",
    "test_shape_build.py",
    "test_rigid_contact.py",
    "test_shadow_find.py",
    "test_mpm_constitutive_laws.py",
    "test_photo_layers.py",
    "test_bake_splats.py",
    "test_mpm_rigid_coupling.py",
    "test_box_segmentation.py",
    "test_signals.py",
    "test_track.py",
    "test_ground_gloss.py",
    "test_shape_fit.py",
    "test_propose.py",
    "test_compose_scene.py",
    "test_import_splats.py",
    "test_correct.py",
    "test_preview.py",
    "test_shape_parts.py",
    "test_image_finish.py",
    "test_headless.py",
    "test_compose.py",
    "test_splats.py",
    "test_diagnose_consistency.py",
    "test_inflated_mesh.py",
    "test_bake_spaces.py",
    "test_background_choice.py",
    "test_fuzz.py",
    "test_contour_evidence.py",
    "test_engines.py",
    "test_camera_estimate.py",
    "test_recorded_files.py",
    "test_image_formation.py",
    "test_default_motion.py",
    "test_models.py",
    "test_diagnose_report.py",
    "test_layering.py",
    "test_panels_draw.py",
    "test_bake_operators.py",
    "test_compose_assets.py",
    "test_penetration.py",
    "test_splat_hull.py",
    "test_gaussian_physics.py",
    "test_light_estimate.py",
    "test_background_fill.py",
    "test_compose_objects.py",
    "test_farm.py",
    "test_cli.py",
    "test_benchmarks.py",
    "test_farm_dask.py",
    "test_mpm_waves.py",
    "test_frames.py",
    "test_outputs.py",
    "test_camera_moves.py",
    "test_compose_physics.py",
    "test_world_and_render_panels.py",
    "test_diagnose_jobs.py",
    "test_guidance_diffusers.py",
    "test_explain.py",
)
"""Files that take longest, in this order: workers begin with them, so that none of them is the last one running."""

NO_BYTECODE = sys.dont_write_bytecode

ONE_THREAD = ("test_raster.py", "test_diagnose_rigid.py", "test_diagnose_rigid_resting.py", "test_diagnose_work.py")
ONE_THREAD += ("test_soft_elements.py", "test_soft_fits.py", "test_rolling_disc.py")
"""Files that ask Taichi for another number of threads, at which its process drops all kernels: they come first."""


def pytest_collection() -> None:
    """Keep the bytecode of test modules, whatever the environment says: each worker imports them all, and pytest takes
    longer to rewrite their assertions than to import them."""
    sys.dont_write_bytecode = False


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Order the files, but not the tests of a file, which may share what a fixture made."""
    sys.dont_write_bytecode = NO_BYTECODE
    rank = {name: index for index, name in enumerate(LONGEST)}
    items.sort(key=lambda item: (item.path.name not in ONE_THREAD, rank.get(item.path.name, len(rank))))


def complete_manifest(*objects: BakedObject, frames: int = 3, **changes) -> BakeManifest:
    """The manifest of a complete bake of ``objects``, from frame 1, 24 a second; ``changes`` are other fields."""
    whole = {"frames": frames, "frames_done": frames, "state": "complete", "objects": objects}
    rest = {"inputs_hash": "0" * 64, "fps": 24.0, "frame_start": 1, "engine": "test", "version": "0", "particles": 1}
    return BakeManifest(**{**whole, **rest, **changes})


LOOKING_AWAY = ((1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 1.0, -1.0), (0.0, -1.0, 0.0, 0.2), (0.0, 0.0, 0.0, 1.0))


@pytest.fixture(scope="session")
def without_trials():
    """A context in which backgrounds are filled in the first way that suits, without trials of all ways.

    They take 40 % of a small reconstruction; test_background_choice.py is about them. Session-wide, so that fixtures of
    any scope can use it.
    """

    @contextlib.contextmanager
    def patched():
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(background_inpainting, "choose_method", lambda task, ways: MethodChoice(ways[0], {}, 0.0))
            yield

    return patched


@pytest.fixture
def first_fill(without_trials):
    with without_trials():
        yield


@pytest.fixture
def own_kernels(tmp_path):
    """Environment of a process whose files may not grow: it may spoil its cache of kernels, a copy of the user's."""
    cache = Path.home() / ".cache" / "taichi" / "ticache"
    copy = tmp_path / "kernels"
    copy.mkdir()
    for path in cache.glob("*") if cache.is_dir() else ():
        with contextlib.suppress(OSError):
            shutil.copy(path, copy)
    return {**os.environ, "TI_OFFLINE_CACHE_FILE_PATH": str(copy)}


@pytest.fixture
def ball_scene(tmp_path):
    """A factory of scene folders with balls of 10 cm a little above the ground, 15 cm apart."""

    def make(*, preset="soft", velocity=(0.0, 0.0, 1.0), count=1, name="scene", height=0.052, **changes) -> Scene:
        root = tmp_path / name
        (root / "meshes").mkdir(parents=True, exist_ok=True)
        items = []
        for index in range(count):
            mesh = trimesh.creation.icosphere(subdivisions=3, radius=0.05)
            mesh.apply_translation((0.15 * index, 0.0, height))
            mesh.export(root / f"meshes/ball{index}.glb")
            items.append(
                SceneObject(
                    name=f"ball{index}",
                    mesh=f"meshes/ball{index}.glb",
                    size_m=0.1,
                    material=load_preset(preset),
                    velocity=velocity,
                )
            )
        grey = np.full((40, 60, 3), 128, np.uint8)
        for file in ("photo.png", "background.png"):
            cv2.imwrite(str(root / file), grey)
        camera = Camera(width=60, height=40, fx=50.0, fy=50.0, cx=30.0, cy=20.0, world_from_camera=LOOKING_AWAY)
        return save_scene(root, SceneModel(**{"camera": camera, "objects": tuple(items), **changes}))

    return make
