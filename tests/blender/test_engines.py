# SPDX-License-Identifier: GPL-3.0-or-later
"""EEVEE makes the pictures that Cycles makes; a device that is not there is replaced and said."""

import os

import numpy as np
import pytest
from physgen.sim.cache.bake_folder import load_bake
from physgen.sim.composite.image_metrics import psnr
from physgen.sim.errors import InputError, RenderError
from physgen.sim.srgb import linear_to_bytes, read_mask

bpy = pytest.importorskip("bpy")
from physgen.physgen_addon.playback.point_caches import open_bake
from physgen.physgen_addon.render import render_engines
from physgen.physgen_addon.render.render_frames import render_frames
from physgen.physgen_addon.render.render_options import RenderOptions
from physgen.physgen_addon.render.renderer import Renderer

SHIFT = (-0.07, 0.03, 0.0)


@pytest.fixture(scope="module")
def drawing():
    """Skips where EEVEE has nothing to draw with."""
    try:
        render_engines.require_graphics()
    except RenderError as error:
        pytest.skip(str(error))


@pytest.mark.long
def test_eevee_draws_the_moved_ball_as_cycles_does(drawing, world, bake):
    """At half the size and one sample; test-all compares whole pictures, soft shadows and outlines."""
    opened = open_bake(load_bake(bake([(0, 0, 0), SHIFT])), world.folder)
    made = {}
    for engine, samples in (("cycles", 16), ("eevee", 1)):
        options = RenderOptions(engine=engine, samples=samples, motion_blur=0.0, scale=0.5)
        renderer = Renderer(world.folder, opened, options)
        made[engine] = renderer.frame(1)
        renderer.close()
    assert not [scene for scene in bpy.data.scenes if scene.name.startswith("PhysGen")]
    cycles, eevee = (linear_to_bytes(frame.beauty) for frame in made.values())
    assert psnr(eevee, cycles) > 30
    shadow, other = (made[engine].shadow.mean(axis=-1) for engine in ("eevee", "cycles"))
    deep = other < 0.75
    assert deep.sum() > 25
    assert abs(float((shadow - other)[deep].mean())) < 0.1


@pytest.mark.slow
def test_eevee_makes_the_same_pictures(drawing, world, bake):
    opened = open_bake(load_bake(bake([(0, 0, 0), SHIFT])), world.folder)
    made = {}
    for engine, samples in (("cycles", 16), ("eevee", 4)):
        renderer = Renderer(world.folder, opened, RenderOptions(engine=engine, samples=samples, motion_blur=0.0))
        made[engine] = [renderer.frame(sample) for sample in (0, 1)]
        renderer.close()
    assert not [scene for scene in bpy.data.scenes if scene.name.startswith("PhysGen")]
    first, moved = (linear_to_bytes(frame.beauty) for frame in made["eevee"])
    assert psnr(first, world.photo, read_mask(world.folder.file("masks/ball.png"))) > 35
    assert psnr(first, world.photo) > 38
    assert psnr(moved, world.moved) > 38
    # Soft shadows of sun and sky, as dark as by Cycles.
    shadow, other = (made[engine][1].shadow.mean(axis=-1) for engine in ("eevee", "cycles"))
    deep = other < 0.75
    assert deep.sum() > 100
    assert abs(float((shadow - other)[deep].mean())) < 0.05
    assert abs(float((shadow - other)[~deep].mean())) < 0.01
    # Outlines are as soft: of the same coverage, with pixels that are partly covered.
    alpha, other = (made[engine][1].objects.alpha for engine in ("eevee", "cycles"))
    assert np.abs(alpha - other).mean() < 2e-3
    assert ((alpha > 0.2) & (alpha < 0.8)).sum() > 20


def test_without_graphics_the_message_says_what_to_install(monkeypatch):
    if os.name != "posix":
        pytest.skip("only Mesa's libraries can be hidden by a variable")
    # No driver is found in an empty list; a process that draws then dies.
    monkeypatch.setenv("__EGL_VENDOR_LIBRARY_FILENAMES", "/nowhere")
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    render_engines.require_graphics.cache_clear()
    with pytest.raises(RenderError, match=r"libegl1.*--engine cycles"):
        render_engines.require_graphics()


def test_missing_device_falls_back_to_cpu(world, bake, tmp_path):
    events = []
    settings = RenderOptions(samples=2, device="metal" if os.uname().sysname != "Darwin" else "cuda")
    baked = bake([(0, 0, 0)])
    first = render_frames(
        world.folder, load_bake(baked), out=tmp_path / "out", options=settings, on_event=events.append
    )
    said = [event["message"] for event in events if event["event"] == "notice"]
    assert f"{settings.device} is not available here; renders on the CPU" in said
    # The picture is the same, so the frames are kept.
    made = first[0].stat().st_mtime_ns
    again = render_frames(world.folder, load_bake(baked), out=tmp_path / "out", options=RenderOptions(samples=2))
    assert again[0].stat().st_mtime_ns == made
    with pytest.raises(InputError, match="device is 'gpu'"):
        RenderOptions(device="gpu")
