# SPDX-License-Identifier: MIT
"""Pictures of a composition by Cycles: colours, masks, whose each pixel is, and the way through the files."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
from physgen.benchmarks.compose_assets import blender_render, pictures, sdf
from physgen.benchmarks.compose_assets import pictures as cameras
from physgen.benchmarks.compose_assets.asset import Asset, Part
from physgen.benchmarks.compose_assets.sdf import Warp, mesh_of

SIZE = 32


@pytest.fixture(scope="module")
def two_balls() -> Asset:
    """A red ball, and a smaller green one before it."""

    def ball(name, centre, radius, colour):
        low, high = (tuple(c + s * 1.2 * radius for c in centre) for s in (-1, 1))
        vertices, faces = mesh_of(sdf.sphere(centre, radius), low, high, radius / 8)
        colours = np.broadcast_to(np.array(colour), vertices.shape)
        return Part(name=name, vertices=vertices, faces=faces, colours=colours)

    return Asset(
        name="balls",
        title="two balls",
        background=ball("red", (0.0, 0.0, 0.1), 0.1, (0.8, 0.1, 0.1)),
        foregrounds=(ball("green", (0.0, -0.14, 0.1), 0.039, (0.1, 0.7, 0.1)),),
        warp=Warp(height=0.2),
    )


def test_pictures_show_whose_each_pixel_is(two_balls, tmp_path, monkeypatch):
    places = (cameras.REFERENCE, *cameras.FITTING[:1], *cameras.HELD_OUT[:1])
    for module in (cameras, pictures):
        monkeypatch.setattr(module, "FITTING", places[1:2])
        monkeypatch.setattr(module, "HELD_OUT", places[2:])
        monkeypatch.setattr(module, "PLACES", places)
    folder = tmp_path / pictures.cache_name(two_balls, SIZE)
    blender_render.shoot(two_balls, SIZE, folder, look=dataclasses.replace(pictures.LOOK, samples=8), threads=1)
    shot = pictures.load(two_balls, folder)
    view, alone, green = shot.views[0], shot.background_views[0], shot.foreground_views[0][0]

    for name, label in (("red", 1), ("green", 2)):
        part = next(part for part in two_balls.parts if part.name == name)
        centre = (part.vertices.min(axis=0) + part.vertices.max(axis=0)) / 2
        x, y, _ = view.camera.project(centre)
        shown = view.pixels[int(y), int(x)]
        assert view.labels[int(y), int(x)] == label
        assert shown.argmax() == label - 1 and shown.max() > 0.4
    corner = view.pixels[0, 0]
    assert view.labels[0, 0] == -1 and view.mask[0, 0] == 0 and np.allclose(corner, 1.0)
    # What stands alone keeps its outline: of a ball, a disc of about its angle.
    distance = np.linalg.norm(view.camera.position - (0.0, 0.0, 0.1))
    radius = view.camera.fx * math.tan(math.asin(0.1 / distance))
    assert alone.mask.sum() == pytest.approx(math.pi * radius**2, rel=0.05)
    assert set(alone.labels.flat) == {-1, 1} and set(green.labels.flat) == {-1, 2}
