# SPDX-License-Identifier: MIT
"""Splats fitted to pictures whose truth is known: a ball with a painted pattern, seen by casting rays."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from physgen.sim.composite.image_metrics import psnr
from physgen.sim.errors import Cancelled, InputError, SimulationError
from physgen.sim.gaussians.image_loss import view_target
from physgen.sim.gaussians.pair_fit import PairFitOptions, fit_pair, initial_splats, pixel_size
from physgen.sim.gaussians.raster.rasteriser import Rasteriser
from physgen.sim.gaussians.splat_fit import (
    GROUPS,
    AdamState,
    FitOptions,
    fit_splats,
    from_parameters,
    parameter_gradients,
    to_parameters,
)
from physgen.sim.gaussians.splats import Splats, joined
from physgen.sim.gaussians.views.posed_images import View, orbit_camera
from physgen.sim.gaussians.views.visual_hull import HullOptions
from physgen.sim.mpm.colliders import Surface
from physgen.sim.mpm.geometry.triangles import squared_distances
from trimesh import Trimesh
from trimesh.creation import icosphere

from .splat_scenes import BLUE, RED, Ball, Ring, views_of


def painted(points):
    """Colours (..., 3) of places on the unit sphere: waves from its radius long."""
    x, y, z = np.moveaxis(points, -1, 0)
    return np.stack([0.5 + 0.35 * np.sin(4 * x + 2 * y), 0.5 + 0.3 * np.sin(5 * y), 0.5 + 0.4 * np.cos(3 * z)], axis=-1)


def cast_ball(camera, name="", samples=3):
    """The painted unit ball by rays, ``samples``² to a pixel, before white."""
    steps = (np.arange(camera.width * samples) + 0.5) / samples
    rays = camera.rays(np.stack(np.meshgrid(steps, steps), axis=-1))
    depth = Ball((0, 0, 0), 1.0).depth(camera.position, rays)
    hit = np.isfinite(depth)
    colours = np.where(hit[..., None], painted(camera.position + np.where(hit, depth, 0)[..., None] * rays), 1.0)
    cells = (camera.height, samples, camera.width, samples)
    pixels = colours.reshape(*cells, 3).mean(axis=(1, 3))
    return View(camera=camera, pixels=pixels, mask=hit.reshape(cells).mean(axis=(1, 3)), name=name)


def around(count, elevation=20.0, turn=0.0):
    places = [(turn + 360 * index / count, elevation * (-1) ** index) for index in range(count)]
    return [orbit_camera(azimuth, up, 3.0, side=96, focal=1.2) for azimuth, up in places]


@pytest.fixture(scope="module")
def ball_views():
    return [cast_ball(camera, f"view {index}") for index, camera in enumerate(around(12))]


@pytest.fixture(scope="module")
def ball():
    mesh = icosphere(subdivisions=3)
    return Surface(vertices=mesh.vertices, faces=mesh.faces)


def some_splats(count=6, seed=0):
    random = np.random.default_rng(seed)
    return Splats(
        centres=random.normal(size=(count, 3)),
        scales=random.uniform(0.05, 0.5, (count, 3)),
        rotations=random.normal(size=(count, 4)),
        opacities=random.uniform(0.1, 0.9, count),
        colours=random.uniform(size=(count, 3)),
    )


def test_free_values_and_back():
    splats = some_splats()
    again = from_parameters(to_parameters(splats))
    for name in GROUPS:
        np.testing.assert_allclose(getattr(again, name), getattr(splats, name), atol=1e-12)


@pytest.mark.parametrize("name", GROUPS)
def test_chain_rule_against_finite_differences(name):
    """Of a loss that is linear in the splats, at quaternions that are not unit."""
    random = np.random.default_rng(5)
    values = to_parameters(some_splats())
    values["rotations"] = values["rotations"] * random.uniform(0.5, 2, (6, 1))
    weights = {group: random.normal(size=values[group].shape) for group in GROUPS}

    def loss(changed):
        splats = from_parameters({**values, name: changed})
        return sum((weights[group] * getattr(splats, group)).sum() for group in GROUPS)

    slope = parameter_gradients(values, SimpleNamespace(**weights))[name]
    direction = random.normal(size=values[name].shape)
    step = 1e-6
    along = (loss(values[name] + step * direction) - loss(values[name] - step * direction)) / (2 * step)
    assert along == pytest.approx((slope * direction).sum(), rel=1e-6)


def test_adam_goes_down_at_its_rate_whatever_the_slope():
    wanted = np.array([[1.0, -2.0, 0.5]])
    descent = AdamState({"centres": np.zeros((1, 3)), "colours": np.zeros((1, 3))})
    first = descent.stepped({"centres": 1e-9 * (descent.values["centres"] - wanted)}, {"centres": 0.1})
    np.testing.assert_allclose(first.values["centres"], 0.1 * np.sign(wanted), rtol=1e-4)
    for _ in range(400):
        descent = descent.stepped({"centres": 1e-9 * (descent.values["centres"] - wanted)}, {"centres": 0.05})
    np.testing.assert_allclose(descent.values["centres"], wanted, atol=1e-3)
    assert not descent.values["colours"].any(), "no rate, no step"


def test_pixels_of_an_occluder_have_no_loss():
    camera = orbit_camera(0, 0, 3.0, side=4, focal=1.2)
    labels = np.array([[-1, 1, 2, 2], [-1, 1, 2, 2], [-1, -1, 2, 2], [-1, -1, -1, -1]], np.int8)
    mask = np.where(labels > 0, 1.0, 0.0)
    mask[3, 3] = 0.4
    pixels = np.full((4, 4, 3), 0.2)
    view = View(camera=camera, pixels=pixels, mask=mask, labels=labels, name="front")
    target = view_target(view, label=2)
    np.testing.assert_array_equal(target.counted, (labels != 1) & (mask != 0.4))
    np.testing.assert_array_equal(target.alpha, labels == 2)
    np.testing.assert_array_equal(target.others.counted, labels == 1)
    np.testing.assert_allclose(target.over((0.0, 0.5, 1.0))[2], [[0, 0.5, 1], [0, 0.5, 1], [0.2] * 3, [0.2] * 3])
    bare = View(camera=camera, pixels=pixels, name="front")
    with pytest.raises(InputError, match="'front' has no labels"):
        view_target(bare, label=2)
    with pytest.raises(InputError, match="'front' has no mask"):
        view_target(bare)


def test_a_start_has_the_colours_that_are_seen_there(ball, ball_views):
    start = initial_splats(ball, 2000, [view_target(view) for view in ball_views], inset=0.05)
    radii = np.linalg.norm(start.centres, axis=1)
    assert radii.min() > 0.93 and radii.max() <= 0.95 + 1e-9, "an icosphere's faces lie a little inside"
    seen = np.abs(start.centres[:, 2]) < 0.8
    assert np.abs(start.colours - painted(start.centres / radii[:, None]))[seen].mean() < 0.05
    np.testing.assert_allclose(initial_splats(ball, 10, []).colours, 0.5)


def test_a_ball_is_met_where_nobody_looked(ball, ball_views):
    """30.7 dB at the reference view is what the whole method has to reach, so its parts must at views never shown."""
    targets = [view_target(view) for view in ball_views]
    inset = pixel_size([view.camera for view in ball_views], ball)
    start = initial_splats(ball, 2500, targets, inset=inset)
    events = []
    fitted = fit_splats(ball_views, start, FitOptions(steps=150), events.append)
    rasteriser = Rasteriser()
    for view in [cast_ball(camera) for camera in around(3, elevation=12, turn=17)]:
        assert psnr(rasteriser.render(fitted.splats, view.camera).colour, view.pixels, peak=1.0) > 30.7
    assert min(fitted.psnr.values()) > 30.7 and len(fitted.psnr) == len(ball_views)
    assert fitted.losses[-20:].mean() < fitted.losses[:20].mean()
    assert events[-1]["done"] == events[-1]["total"] == 150
    middle = rasteriser.render(fitted.splats, ball_views[0].camera).alpha[40:56, 40:56]
    assert middle.min() > 0.95, "backgrounds that change make the inside solid"


def test_frozen_fields_stay(ball, ball_views):
    start = initial_splats(ball, 300, [])
    fitted = fit_splats(ball_views, start, FitOptions(steps=3, frozen=frozenset({"centres", "opacities"})))
    np.testing.assert_array_equal(fitted.splats.centres, start.centres)
    np.testing.assert_allclose(fitted.splats.opacities, start.opacities, atol=1e-12)
    assert not np.allclose(fitted.splats.colours, start.colours)


def test_splats_do_not_stay_in_front_of_the_other_object():
    """A shell around the ball that no pixel there owns: unseen it stays, in company it clears away."""
    view, *_ = views_of([Ball((0, 0, 0), 0.5)], 1)
    labels = view.labels.copy()
    labels[:2, :2] = 2
    mask = view.mask.copy()
    mask[:2, :2] = 1
    view = View(camera=view.camera, pixels=view.pixels, mask=mask, labels=labels, name="front")
    shapes = [icosphere(subdivisions=2, radius=radius) for radius in (0.5, 0.6)]
    inner, shell = (initial_splats(Surface(vertices=m.vertices, faces=m.faces), 400, []) for m in shapes)
    company = inner.changed(colours=np.tile(RED, (400, 1)))
    frozen = frozenset({"centres", "colours"})
    options = FitOptions(steps=40, label=2, frozen=frozen, opacity_rate=0.2, alpha_weight=0.0)
    off = []
    for beside in (None, company):
        fitted = fit_splats([view], shell, options, fixed=beside).splats
        off.append(np.abs(Rasteriser().render(joined([company, fitted]), view.camera).colour[48, 48] - RED).max())
    assert off[0] > 0.3, "grey before red"
    assert off[1] < 0.05


def test_a_fit_can_be_stopped_and_says_what_is_wrong(ball, ball_views):
    start = initial_splats(ball, 300, [])
    asked = []
    with pytest.raises(Cancelled, match="at step 2 of 50"):
        fit_splats(ball_views, start, FitOptions(steps=50), cancelled=lambda: asked.append(0) or len(asked) > 2)
    with pytest.raises(InputError, match="no views"):
        fit_splats([], start)
    empty = View(camera=ball_views[0].camera, pixels=np.ones((96, 96, 3)), mask=np.zeros((96, 96)), name="empty")
    with pytest.raises(InputError, match="no view shows the object"):
        fit_splats([empty], start)
    with pytest.raises(SimulationError, match=r"the loss is .* at step 0"):
        fit_splats(ball_views, start.changed(colours=np.full((300, 3), 1e30)))
    with pytest.raises(InputError, match="fit option steps is 0"):
        FitOptions(steps=0)
    with pytest.raises(InputError, match="frozen is \\['colour'\\]"):
        FitOptions(frozen=frozenset({"colour"}))


def distances(points, triangles):
    """Of each point to the nearest triangle."""
    near = [squared_distances(np.tile(point, (len(triangles), 1)), triangles).min() for point in points]
    return np.sqrt(near)


def test_a_ball_and_the_ring_around_it_are_told_apart():
    ball, ring = Ball((0, 0, 0), 0.5), Ring(0.55, 0.12)
    few = FitOptions(steps=40)
    options = PairFitOptions(
        background_splats=800,
        foreground_splats=800,
        background_fit=few,
        foreground_fit=few,
        hull=HullOptions(resolution=32),
    )
    pair = fit_pair(views_of([ball, ring], 10), views_of([ball], 10), options)
    body = Trimesh(pair.foreground_surface.vertices, pair.foreground_surface.faces)
    assert body.is_watertight and body.volume > 0
    step = 2 * 0.67 / 32
    assert np.abs(body.bounds - [[-0.67, -0.67, -0.12], [0.67, 0.67, 0.12]]).max() < 2 * step
    # The centres have not left the surface on which the simulation's boundary lies.
    assert distances(pair.foreground.centres, body.triangles).max() < 1e-9
    assert np.abs(pair.foreground.colours - BLUE).mean() < 0.1, "without the ball's red"
    assert np.abs(ball.distance(pair.background.centres)).mean() < step
    assert min(pair.background_fit.psnr.values()) > 25 and min(pair.foreground_fit.psnr.values()) > 25
