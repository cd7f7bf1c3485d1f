# SPDX-License-Identifier: MIT
"""Algorithm 1 and its ablations on a ball that swells through a ring."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import trimesh
from physgen.sim.composite.image_metrics import psnr
from physgen.sim.errors import Cancelled, InputError, SimulationError
from physgen.sim.gaussians.compose.compose_options import METHODS, ComposeOptions
from physgen.sim.gaussians.compose.composition import compose
from physgen.sim.gaussians.compose.composition_parts import CompositionPart, Reference
from physgen.sim.gaussians.compose.penetration import penetration_of_meshes
from physgen.sim.gaussians.mesh_to_splats import splats_on_mesh
from physgen.sim.gaussians.raster.rasteriser import Rasteriser
from physgen.sim.gaussians.splats import joined
from physgen.sim.gaussians.views.posed_images import orbit_cameras
from physgen.sim.mpm.colliders import Surface

SIZE = 64
UP = np.array([0.0, 0.0, 0.015])
SHORT = ComposeOptions(steps=20, size=SIZE, cells=16, substeps=10)


def piece(name, mesh, colour, count=700):
    vertices, faces = np.asarray(mesh.vertices), np.asarray(mesh.faces)
    return CompositionPart(
        name=name,
        splats=splats_on_mesh(vertices, faces, colour(vertices), count),
        surface=Surface(vertices=vertices, faces=faces),
    )


def spots(places):
    """Colours that tell where on the ball a place is."""
    return np.clip(0.5 + 0.4 * np.sin(70.0 * places + np.arange(3)), 0.0, 1.0)


def swollen(one):
    """The ball's middle swollen by 15 %, which is through the ring, and all of it shifted."""

    def warp(places):
        swell = 1.0 + 0.15 * np.exp(-((places[:, 2:] / 0.03) ** 2))
        return places * swell + [0.003, 0.0, 0.002]

    return dataclasses.replace(
        one,
        splats=one.splats.changed(centres=warp(one.splats.centres)),
        surface=Surface(vertices=warp(one.surface.vertices), faces=one.surface.faces),
    )


@pytest.fixture(scope="module")
def ring():
    mesh = trimesh.creation.torus(0.06, 0.0085, major_sections=48, minor_sections=16)
    return piece("ring", mesh, lambda places: np.tile([0.9, 0.7, 0.2], (len(places), 1)), count=300)


@pytest.fixture(scope="module")
def ball():
    return piece("ball", trimesh.creation.icosphere(subdivisions=4, radius=0.05), spots)


@pytest.fixture(scope="module")
def reference(ring, ball):
    camera = orbit_cameras(np.concatenate([ring.splats.centres, ball.splats.centres]), SIZE)[0]
    pixels = Rasteriser().render(joined([ball.splats, ring.splats]), camera).colour.astype(np.float64)
    return Reference(camera=camera, pixels=np.clip(pixels, 0, 1), backdrop=np.ones_like(pixels))


BRIEF = dataclasses.replace(SHORT, steps=3)


@pytest.fixture(scope="module")
def composed(ring, ball, reference):
    """The ring and the swollen ball after a few steps."""
    return compose([ring, swollen(ball)], reference=reference, options=BRIEF)


def seen(pieces, camera, truth):
    """dB between pictures of two lists of pieces."""
    pictures = [Rasteriser().render(joined([one.splats for one in some]), camera).colour for some in (pieces, truth)]
    return psnr(*pictures, peak=1.0)


def overlap(pieces):
    """Volume in m³ of the last in the others."""
    return sum(penetration_of_meshes(pieces[-1].surface, other.surface).volume for other in pieces[:-1])


@pytest.mark.long
def test_methods_do_what_they_are_for(ring, ball, reference):
    """Physics takes penetration away, pictures the distortion; Algorithm 1 both, and best."""
    begin, truth = swollen(ball), [ring, ball]
    before = overlap([ring, begin])
    left, quality, astray = {}, {}, {}
    for method in METHODS:
        result = compose([ring, begin], reference=reference, options=dataclasses.replace(SHORT, method=method))
        assert result.parts[0] is ring and result.parts[1].name == "ball"
        assert [record.step for record in result.history] == list(range(SHORT.steps))
        left[method] = overlap(result.parts) / before
        quality[method] = seen(result.parts, reference.camera, truth)
        way = result.parts[1].splats.centres - ball.splats.centres
        astray[method] = np.sqrt((way**2).sum(axis=1).mean())
    started = seen([ring, begin], reference.camera, truth)
    assert left["pse-sds"] <= 0.01 and left["ppps"] <= 0.01
    # Pictures alone show one side: what they cannot see stays in the ring.
    assert left["sds"] > 0.05
    assert quality["ppps"] < started + 3.0
    assert quality["pse-sds"] > started + 6.0
    # Matter ends nearer to where it belongs than points that go wherever the one picture likes them.
    assert astray["pse-sds"] == min(astray.values())


def test_equal_input_gives_equal_bytes(ring, ball, reference, composed):
    first, second = composed, compose([ring, swollen(ball)], reference=reference, options=BRIEF)
    for name in ("centres", "scales", "rotations"):
        np.testing.assert_array_equal(
            getattr(first.parts[1].splats, name), getattr(second.parts[1].splats, name), err_msg=name
        )
    np.testing.assert_array_equal(first.parts[1].surface.vertices, second.parts[1].surface.vertices)


def test_colours_opacities_and_other_parts_are_unchanged(ball, composed):
    begin, after = swollen(ball), composed.parts[1]
    np.testing.assert_array_equal(after.splats.colours, begin.splats.colours)
    np.testing.assert_array_equal(after.splats.opacities, begin.splats.opacities)
    np.testing.assert_array_equal(after.surface.faces, begin.surface.faces)
    assert (after.splats.centres != begin.splats.centres).any()


@pytest.mark.long
def test_of_three_the_later_yield_to_all_before(ring, ball):
    upper = dataclasses.replace(
        ring,
        name="upper",
        splats=ring.splats.changed(centres=ring.splats.centres + UP),
        surface=Surface(vertices=ring.surface.vertices + UP, faces=ring.surface.faces),
    )
    options = dataclasses.replace(SHORT, method="ppps", steps=8)
    begin = [ring, upper, swollen(ball)]
    result = compose(begin, reference=None, options=options)
    assert [one.name for one in result.parts] == ["ring", "upper", "ball"]
    assert result.parts[0] is ring
    for count in (2, 3):
        assert overlap(result.parts[:count]) <= 0.01 * overlap(begin)
    assert {record.part for record in result.history} == {"upper", "ball"}


class Broken:
    """A guidance that answers with no numbers."""

    def gradient(self, seen, timestep, random):
        return np.full(seen.picture.shape, np.nan)


def test_a_broken_guidance_is_said(ring, ball, reference):
    options = dataclasses.replace(SHORT, steps=2)
    result = compose([ring, swollen(ball)], reference=reference, guidance={"ball": Broken()}, options=options)
    assert any("Broken" in note for note in result.notes)
    assert np.isfinite(result.parts[1].splats.centres).all()
    with pytest.raises(SimulationError, match="Broken"):
        compose(
            [ring, swollen(ball)],
            reference=reference,
            guidance={"ball": Broken()},
            options=dataclasses.replace(SHORT, steps=6),
        )


def test_impossible_compositions_are_refused(ring, ball, reference):
    with pytest.raises(InputError, match="at least two"):
        compose([ring], reference=reference)
    with pytest.raises(InputError, match="without a picture"):
        compose([ring, ball], reference=None)
    with pytest.raises(InputError, match="no deformable object has that name"):
        compose([ring, ball], reference=reference, guidance={"ring": Broken()})
    holed = dataclasses.replace(ring, surface=Surface(vertices=ring.surface.vertices, faces=ring.surface.faces[1:]))
    with pytest.raises(InputError, match="ring"):
        compose([holed, ball], reference=reference, options=SHORT)
    with pytest.raises(Cancelled):
        compose([ring, swollen(ball)], reference=reference, options=SHORT, cancelled=lambda: True)
    with pytest.raises(InputError, match="has 3 splats"):
        dataclasses.replace(ball, splats=ball.splats.subset(np.arange(3)))
