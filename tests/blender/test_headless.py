# SPDX-License-Identifier: GPL-3.0-or-later
"""The scripts of ``batch`` as processes: arguments, exit codes, signals, and where modules and Pythons are found."""

import json
import os
import shutil
import signal
import site
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from physgen.sim.cache.bake_folder import MANIFEST_FILE, load_bake
from physgen.sim.errors import InputError
from physgen.sim.folder_lock import folder_lock
from physgen.sim.scene.folder import load_scene
from physgen.sim.srgb import read_rgb

bpy = pytest.importorskip("bpy")
from physgen.physgen_addon.render.render_frames import render_frames
from physgen.physgen_addon.render.render_options import RenderOptions

BATCH = Path(__file__).resolve().parents[2] / "batch"
QUICK = ["--samples", "1", "--scale", "0.25", "--threads", "1", "--json"]
SHIFTS = [(0.01 * i, 0, 0) for i in range(6)]
BARE = "import runpy, sys; sys.path += [sys.argv[1]]; del sys.argv[:2]; runpy.run_path(sys.argv[0], {}, '__main__')"
"""A Python that has only what lies in a folder, as Blender has only its own."""


def start(tmp_path, *command, **environment):
    """Start ``command`` with a temporary folder of its own, which it must leave empty."""
    (tmp_path / "tmp").mkdir(exist_ok=True)
    kept = {k: v for k, v in os.environ.items() if not k.startswith("PHYSGEN_")}
    surroundings = {**kept, "TMPDIR": str(tmp_path / "tmp"), **environment}
    words = [str(word) for word in command]
    return subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=surroundings)


def ended(process):
    """Exit code, standard output, standard error."""
    out, err = process.communicate(timeout=300)
    return process.returncode, out, err


def litter(tmp_path, out):
    """What is left behind besides complete frames and their ledger."""
    inside = [p.name for p in out.iterdir() if (p.name != "frames.json" and p.suffix != ".png") or p.name[0] == "."]
    return inside + [p.name for p in (tmp_path / "tmp").iterdir()]


@pytest.fixture(scope="module")
def bare(tmp_path_factory):
    """A folder with numpy and Blender alone, and the command that runs a script with it."""
    folder = tmp_path_factory.mktemp("bare")
    for where in map(Path, site.getsitepackages()):
        for name in ("numpy", "numpy.libs", "bpy"):
            if (where / name).exists():
                (folder / name).symlink_to(where / name)
    return [sys.executable, "-I", "-S", "-c", BARE, folder]


def test_help_and_usage_need_no_scene(tmp_path):
    scripts = ["render.py", "export.py", "bake.py", "reconstruct.py", "diagnose.py"]
    asked = [start(tmp_path, sys.executable, BATCH / name, "--help") for name in scripts]
    wrong = [start(tmp_path, sys.executable, BATCH / name, "--", "--nonsense") for name in scripts[:2]]
    for name, process in zip(scripts, asked, strict=True):
        code, out, _ = ended(process)
        assert code == 0 and out.startswith("usage: ") and "--out" in out, name
    assert [ended(process)[0] for process in wrong] == [2, 2]


def test_a_denoiser_that_cannot_be_loaded_costs_a_notice_and_no_frame(world, bake, tmp_path):
    """OIDN_DEVICE_CPU=0 keeps OpenImageDenoise from loading its device, with which Cycles would end every render. With
    it again, the frame is rendered anew."""
    out = tmp_path / "out"
    arguments = [world.folder.root, "--bake", bake(SHIFTS[:1]), "--out", out, *QUICK]
    for device, noisy in (("0", True), ("1", False)):
        process = start(tmp_path, sys.executable, BATCH / "render.py", *arguments, OIDN_DEVICE_CPU=device)
        code, said, err = ended(process)
        assert code == 0, err
        assert ("frames are not denoised" in said) is noisy and "up to date" not in said
        assert len(list(out.glob("*.png"))) == 1


def test_stopped_between_frames(world, bake, tmp_path):
    out = tmp_path / "out"
    arguments = [world.folder.root, "--bake", bake(SHIFTS), "--out", out, *QUICK, "--samples", 64]
    process = start(tmp_path, sys.executable, BATCH / "render.py", *arguments)
    for line in process.stdout:
        if json.loads(line).get("done", 0) >= 1:
            process.send_signal(signal.SIGTERM)
            break
    code, said, _ = ended(process)
    assert code == 130
    assert json.loads(said.splitlines()[-1])["kind"] == "Cancelled"
    frames = sorted(out.glob("*.png"))
    assert 1 <= len(frames) < len(SHIFTS) and all(read_rgb(path).shape == (30, 40, 3) for path in frames)
    assert litter(tmp_path, out) == []


def test_stopped_within_a_frame_that_nobody_waits_for(world, bake, tmp_path):
    out = tmp_path / "out"
    arguments = [world.folder.root, "--bake", bake(SHIFTS), "--out", out, "--json", "--threads", 1]
    process = start(tmp_path, sys.executable, BATCH / "render.py", *arguments, "--samples", 4096, "--scale", 4)
    assert json.loads(process.stdout.readline())["message"] == "preparing"
    process.send_signal(signal.SIGINT)
    time.sleep(1.3)  # sooner it is the same wish
    process.send_signal(signal.SIGINT)
    code, said, _ = ended(process)
    assert code == 130
    assert "within a frame" in json.loads(said.splitlines()[-1])["message"]
    assert litter(tmp_path, out) == []


def test_a_folder_in_use_is_refused_and_not_disturbed(world, bake, tmp_path):
    out = tmp_path / "out"
    with folder_lock(out):
        arguments = [world.folder.root, "--bake", bake(SHIFTS), "--out", out, *QUICK]
        code, said, _ = ended(start(tmp_path, sys.executable, BATCH / "render.py", *arguments))
        assert code == 3
        assert f"in use by process {os.getpid()}; wait for it" in json.loads(said)["message"]
        assert [p.name for p in out.iterdir()] == [".lock"]


def test_missing_packages_are_named_and_found_on_a_given_path(world, bake, bare, tmp_path):
    arguments = [world.folder.root, "--bake", bake(SHIFTS), "--out", tmp_path / "out", "--frames", "1", *QUICK]
    lacking = start(tmp_path, *bare, BATCH / "render.py", *arguments, HOME=str(tmp_path))
    here = {"HOME": str(tmp_path), "PHYSGEN_PYTHON": sys.executable}
    found = start(tmp_path, *bare, BATCH / "render.py", *arguments, **here)
    code, said, _ = ended(lacking)
    message = json.loads(said)["message"]
    assert code == 5 and "lacks scipy, trimesh, PIL, cv2, OpenImageIO" in message
    assert "-m pip install --target " in message and f'"numpy=={np.__version__}"' in message
    code, said, complaints = ended(found)
    assert code == 0, complaints
    assert f"are taken from {sys.executable}" in json.loads(said.splitlines()[0])["message"]
    elsewhere = start(tmp_path, *bare, BATCH / "render.py", *arguments, PHYSGEN_PACKAGES=str(tmp_path / "gone"))
    code, said, _ = ended(elsewhere)
    assert code == 3 and "which is not a folder" in json.loads(said)["message"]


def test_a_verb_that_simulates_becomes_the_python_that_can(bare, tmp_path):
    arguments = [BATCH / "bake.py", tmp_path / "none", "--out", tmp_path / "bake", "--json"]
    able = start(tmp_path, *bare, *arguments, PHYSGEN_PYTHON=sys.executable)
    unable = start(tmp_path, *bare, *arguments, PHYSGEN_PYTHON="/nowhere/python")
    for process, words in ((able, "scene.json: there is no such file"), (unable, "no Python that can be started")):
        code, said, _ = ended(process)
        assert code == 3 and words in json.loads(said)["message"]


def test_incomplete_bakes_are_reported_with_a_remedy(world, bake, tmp_path, held_elsewhere):
    folder, options = bake(SHIFTS), RenderOptions(samples=1, scale=0.25)
    path = folder / MANIFEST_FILE
    whole = json.loads(path.read_text())

    def refusal(asked=None, **changes):
        path.write_text(json.dumps({**whole, **changes}))
        with pytest.raises(InputError) as raised:
            render_frames(world.folder, load_bake(folder), out=tmp_path / "out", options=options, frames=asked)
        return str(raised.value)

    assert "frames 1 to 6 are baked; bake more" in refusal("1-48")
    assert "was stopped: run `physgen bake` again" in refusal("1-48", frames=48, frames_done=6, state="cancelled")
    with held_elsewhere(folder):
        assert "is still running: wait" in refusal("1-48", frames=48, frames_done=6, state="running")
    assert "format is 'physgen-bake/2', this version reads 'physgen-bake/1'; update" in refusal(format="physgen-bake/2")
    assert "PhysGen 9.0 wrote it, this is" in refusal(version="9.0", wobble=1)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("content", ["garbage", "cut", "dark"])
def test_an_environment_that_cannot_be_used_is_named(world, bake, tmp_path, content):
    import OpenImageIO as oiio

    root = tmp_path / "scene"
    shutil.copytree(world.folder.root, root)
    path = root / "sky.exr"
    pixels = np.ones((16, 32, 3), np.float32) * (0.0 if content == "dark" else 1.0)
    target = oiio.ImageOutput.create(str(path))
    target.open(str(path), oiio.ImageSpec(32, 16, 3, "float"))
    target.write_image(pixels)
    target.close()
    if content != "dark":
        path.write_bytes(b"\1" * 900 if content == "garbage" else path.read_bytes()[:300])
    scene = json.loads((root / "scene.json").read_text())
    scene["light"]["environment"] = "sky.exr"
    (root / "scene.json").write_text(json.dumps(scene))
    with pytest.raises(InputError, match=r"sky\.exr: .*; (restore|make|give)") as raised:
        render_frames(
            load_scene(root),
            load_bake(bake(SHIFTS)),
            out=tmp_path / "out",
            options=RenderOptions(samples=1, scale=0.25),
        )
    assert "\n" not in str(raised.value)
    assert not (tmp_path / "out").exists(), "the folder that it made goes again"
