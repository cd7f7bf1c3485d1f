# SPDX-License-Identifier: MIT
"""The rasteriser of splats against a plain double precision one, and its gradients against finite differences of it."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from physgen.sim.errors import InputError
from physgen.sim.gaussians.raster.rasteriser import Rasteriser
from physgen.sim.gaussians.splats import Splats, joined
from physgen.sim.mpm.solver_options import SolverOptions
from physgen.sim.scene.model import Camera
from scipy.spatial.transform import Rotation

NAMES = ("centres", "scales", "rotations", "opacities", "colours")
BACKGROUND = (0.3, 0.6, 0.9)
KINDS = ("mixed", "needles", "beside", "deep")


@pytest.fixture(scope="module")
def rasteriser():
    return Rasteriser()


def camera(width=37, height=29, *, distance=1.0, fx=45.0, fy=38.0, cx=16.0, cy=17.5):
    """From ``distance`` before the world's origin, tilted; focal lengths differ and the axis is off the middle."""
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_euler("xyz", (-80, 7, 20), degrees=True).as_matrix()
    pose[:3, 3] = -distance * pose[:3, 2]
    return Camera(width=width, height=height, fx=fx, fy=fy, cx=cx, cy=cy, world_from_camera=pose)


def scene(kind, count=24):
    """Splats around the origin, every fifth nearly opaque.

    mixed: of all sizes and shapes, some in part beside the picture, some behind the camera. needles: a metre long and
    a millimetre thick. beside: large ones with their centres where J stands still. deep: so opaque that pixels finish.
    """
    random = np.random.default_rng(sum(map(ord, kind)))
    centres = random.normal(size=(count, 3)) * 0.4
    scales = np.exp(random.uniform(np.log(0.005), np.log(0.4), (count, 3)))
    opacities = random.uniform(0.02, 0.95, count)
    opacities[::5] = 1.0 - 10.0 ** random.uniform(-4, -2, len(opacities[::5]))
    if kind == "mixed":
        centres[:4] = in_world(random.normal(size=(4, 3)) - (0, 0, 1.5))
    if kind == "needles":
        scales = random.permuted(np.tile([1.0, 1e-3, 1e-3], (count, 1)), axis=1)
    if kind == "beside":
        depth = random.uniform(0.3, 1.0, (count, 1))
        sides = np.where(random.uniform(size=(count, 2)) < 0.5, -1.0, 1.0) * random.uniform(0.8, 1.6, (count, 2))
        centres, scales = in_world(np.column_stack([sides * depth, depth])), scales + 0.2 * depth
    if kind == "deep":
        scales, opacities = scales + 0.3, np.maximum(opacities, 0.9)
        centres = in_world(np.column_stack([random.normal(size=(count, 2)) * 0.1, random.uniform(1, 2, count)]))
    return Splats(
        centres=centres,
        scales=scales,
        rotations=random.normal(size=(count, 4)),
        opacities=opacities,
        colours=random.uniform(0, 1, (count, 3)),
    )


def in_world(local, view=None):
    """Points of the camera's frame in the world's."""
    pose = np.asarray((view or camera()).world_from_camera)
    return local @ pose[:3, :3].T + pose[:3, 3]


def one(place=(0.0, 0.0, 1.0), opacity=0.5, colour=(0.2, 0.4, 0.8), scale=0.05):
    """A round splat at ``place`` in the camera's frame."""
    return Splats(
        centres=in_world(np.array([place])),
        scales=np.full((1, 3), scale),
        rotations=np.array([[1.0, 0.0, 0.0, 0.0]]),
        opacities=np.array([opacity]),
        colours=np.array([colour]),
    )


def plain(splats, view, background=BACKGROUND):
    """The same picture by the formulas as they stand in docs/splats.md, every splat in every pixel: colour, alpha,
    depth."""
    pose = np.asarray(view.world_from_camera)
    local = (splats.centres - pose[:3, 3]) @ pose[:3, :3]
    size = np.array([view.width, view.height])
    focal, middle = np.array([view.fx, view.fy]), np.array([view.cx, view.cy])
    low, high = (-0.15 * size - middle) / focal, (1.15 * size - middle) / focal
    y, x = np.mgrid[: view.height, : view.width] + 0.5
    colour = np.zeros((view.height, view.width, 3))
    depth, light = np.zeros_like(x), np.ones_like(x)
    for i in np.argsort(local[:, 2], kind="stable"):
        p = local[i]
        if p[2] <= 0.01:
            continue
        ratio = np.clip(p[:2] / p[2], low, high)
        slopes = focal[:, None] / p[2] * np.column_stack([np.eye(2), -ratio])
        seen = slopes @ pose[:3, :3].T
        inverse = np.linalg.inv(seen @ splats.covariances()[i] @ seen.T + 0.3 * np.eye(2))
        off = np.stack([x, y], axis=-1) - (focal * p[:2] / p[2] + middle)
        share = splats.opacities[i] * np.exp(-0.5 * np.einsum("...i,ij,...j", off, inverse, off))
        alpha = np.clip(np.where(share > 1 / 256, share, 2 * share - 1 / 256), 0, 0.999)
        weight = np.where(light >= 1e-5, light * alpha, 0.0)
        colour += weight[..., None] * splats.colours[i]
        depth += weight * p[2]
        light -= weight
    with np.errstate(invalid="ignore"):
        depth = np.where(light < 1, depth / (1 - light), 0.0)
    return colour + light[..., None] * np.asarray(background), 1 - light, depth


def raised(splats, name, index, step):
    """With one number of one array ``step`` larger, still in the splats' range."""
    value = getattr(splats, name).copy()
    value[index] += step
    return dataclasses.replace(splats, **{name: value})


def upstream():
    random = np.random.default_rng(0)
    return random.normal(size=(29, 37, 3)), random.normal(size=(29, 37))


def same(first, second):
    return all(
        getattr(first, field.name).tobytes() == getattr(second, field.name).tobytes()
        for field in dataclasses.fields(first)
    )


@pytest.mark.parametrize("kind", KINDS)
def test_the_picture_is_that_of_the_formulas(rasteriser, kind):
    splats, view = scene(kind, 100), camera()
    found = rasteriser.render(splats, view, background=BACKGROUND)
    colour, alpha, depth = plain(splats, view)
    assert alpha.mean() > 0.1
    np.testing.assert_allclose(found.colour, colour, atol=3e-5)
    np.testing.assert_allclose(found.alpha, alpha, atol=3e-5)
    np.testing.assert_allclose(found.depth * found.alpha, depth * alpha, atol=3e-5)


@pytest.mark.parametrize("kind", KINDS)
def test_gradients_are_those_of_finite_differences(rasteriser, kind):
    """All numbers of all splats, against central differences of the plain picture."""
    splats, view = scene(kind), camera()
    d_colour, d_alpha = upstream()
    rasteriser.render(splats, view, background=BACKGROUND)
    found = rasteriser.gradients(d_colour, d_alpha)

    def loss(changed):
        colour, alpha, _ = plain(changed, view)
        return np.sum(colour * d_colour) + np.sum(alpha * d_alpha)

    for name in NAMES:
        wanted = np.zeros_like(getattr(splats, name))
        for index in np.ndindex(*wanted.shape):
            step = 1e-6 * (splats.scales[index[0]].min() if name in ("centres", "scales") else 1.0)
            difference = loss(raised(splats, name, index, step)) - loss(raised(splats, name, index, -step))
            wanted[index] = difference / (2 * step)
        error = np.linalg.norm(getattr(found, name) - wanted)
        assert error < 1e-3 * np.linalg.norm(wanted), name


def test_scenes_hold_what_they_are_meant_to():
    view = camera()
    mixed, beside = (view.project(scene(kind).centres) for kind in ("mixed", "beside"))
    assert (mixed[:, 2] < 0).sum() >= 2
    across = beside[:, 0] / view.width
    assert ((across < -0.15) | (across > 1.15)).mean() > 0.8
    _, alpha, _ = plain(scene("deep", 100), view)
    assert (1 - alpha < 1e-5).mean() > 0.3


def test_gradients_are_those_of_its_own_pictures(rasteriser):
    """Along the gradient, the loss of single precision pictures rises by the gradient's squared length."""
    splats, view = scene("mixed", 60), camera()
    splats = splats.changed(opacities=0.98 * splats.opacities)
    d_colour, d_alpha = upstream()
    rasteriser.render(splats, view, background=BACKGROUND)
    found = rasteriser.gradients(d_colour, d_alpha)
    for name, step in zip(NAMES, (2e-4, 2e-4, 2e-3, 2e-3, 0.1), strict=True):
        way = getattr(found, name) / np.linalg.norm(getattr(found, name))
        sides = []
        for sign in (-1, 1):
            moved = dataclasses.replace(splats, **{name: getattr(splats, name) + sign * step * way})
            seen = rasteriser.render(moved, view, background=BACKGROUND)
            sides.append(np.sum(seen.colour * d_colour) + np.sum(seen.alpha * d_alpha))
        slope = (sides[1] - sides[0]) / (2 * step)
        np.testing.assert_allclose(slope, np.linalg.norm(getattr(found, name)), rtol=1e-3, err_msg=name)


def test_a_splat_in_the_middle_of_a_pixel_covers_it_by_its_opacity(rasteriser):
    view = camera(31, 31, fx=40.0, fy=40.0, cx=15.5, cy=15.5)
    seen = rasteriser.render(one(), view, background=(1.0, 1.0, 1.0))
    np.testing.assert_allclose(seen.alpha[15, 15], 0.5, rtol=1e-6)
    np.testing.assert_allclose(seen.colour[15, 15], 0.5 * np.array([0.2, 0.4, 0.8]) + 0.5, rtol=1e-6)
    np.testing.assert_allclose(seen.depth[15, 15], 1.0, rtol=1e-6)
    # A standard deviation of 0.05 m at 1 m and 40 pixels: 2 pixels, and the low pass.
    np.testing.assert_allclose(seen.alpha[15, 17], 0.5 * np.exp(-0.5 * 4 / (4 + 0.3)), rtol=1e-6)
    assert seen.depth[0, 0] == 0 and seen.alpha[0, 0] == 0


def test_the_nearer_splat_is_in_front_whatever_the_order(rasteriser):
    near, far = one((0, 0, 1.0), 0.9, (1, 0, 0)), one((0, 0, 1.2), 0.9, (0, 0, 1))
    first, second = (rasteriser.render(joined(parts), camera()) for parts in ((near, far), (far, near)))
    assert same(first, second)
    red, _, blue = first.colour[17, 15]
    assert red > 5 * blue


def test_equal_input_gives_equal_bytes_on_any_number_of_threads():
    """And a restart of Taichi between a rendering and its gradients loses nothing."""
    splats, view = scene("mixed", 200), camera(70, 50)
    d_colour = np.random.default_rng(1).normal(size=(50, 70, 3))
    several, single = Rasteriser(solver=SolverOptions(threads=2)), Rasteriser(solver=SolverOptions(threads=1))
    pictures = [maker.render(splats, view) for maker in (several, single, several)]
    assert same(pictures[0], pictures[1]) and same(pictures[0], pictures[2])
    gradients = [maker.gradients(d_colour) for maker in (several, single)]
    several.render(splats, view)
    gradients.append(several.gradients(d_colour))
    assert same(gradients[0], gradients[1]) and same(gradients[0], gradients[2])


@pytest.mark.parametrize("size", [(1, 1), (16, 16), (17, 3)])
def test_pictures_need_not_be_whole_tiles(rasteriser, size):
    splats = scene("mixed", 60)
    wanted, _, _ = plain(splats, camera(*size))
    np.testing.assert_allclose(
        rasteriser.render(splats, camera(*size), background=BACKGROUND).colour, wanted, atol=3e-5
    )


EMPTY = Splats(
    centres=np.zeros((0, 3)),
    scales=np.zeros((0, 3)),
    rotations=np.zeros((0, 4)),
    opacities=np.zeros(0),
    colours=np.zeros((0, 3)),
)


@pytest.mark.parametrize(
    "splats",
    [EMPTY, one((0, 0, -1.0)), one(opacity=0.0), one((0, 0, 0.001)), one((1e200, 0, 1e200)), one((9.0, 0.0, 1.0))],
    ids=["none", "behind", "clear", "too near", "too far", "beside"],
)
def test_empty_view_is_background(rasteriser, splats):
    seen = rasteriser.render(splats, camera(), background=BACKGROUND)
    np.testing.assert_array_equal(seen.colour, np.broadcast_to(np.float32(BACKGROUND), (29, 37, 3)))
    assert not seen.alpha.any() and not seen.depth.any()
    found = rasteriser.gradients(*upstream())
    assert all(not getattr(found, name).any() for name in NAMES)
    assert all(getattr(found, name).shape == getattr(splats, name).shape for name in NAMES)


def test_enormous_splats_cover_all(rasteriser):
    splats = joined([one(scale=1e6, opacity=0.5, colour=(1, 0, 0)), one((0, 0, 2.0), scale=1e6, opacity=1.0)])
    seen = rasteriser.render(splats, camera(50, 50))
    np.testing.assert_allclose(seen.alpha, 1 - 0.5 * 0.001, rtol=1e-6)
    assert all(np.isfinite(getattr(rasteriser.gradients(seen.colour), name)).all() for name in NAMES)


def test_more_than_memory_holds_is_said(rasteriser):
    splats = joined([one(scale=100.0)] * 5000)
    with pytest.raises(InputError, match="5000 splats in an image of 1024x1024 cover 20480000 tiles of 16 pixels"):
        rasteriser.render(splats, camera(1024, 1024))
    with pytest.raises(InputError, match="100000x100000"):
        rasteriser.render(splats, camera(100_000, 100_000))


def test_bad_input_is_said():
    fresh = Rasteriser()
    with pytest.raises(InputError, match="nothing has been rendered"):
        fresh.gradients(*upstream())
    with pytest.raises(InputError, match="background"):
        fresh.render(one(), camera(), background=(1.0, float("nan"), 0.0))
    fresh.render(one(), camera())
    d_colour, d_alpha = upstream()
    with pytest.raises(InputError, match="d_colour has shape"):
        fresh.gradients(d_colour[1:])
    with pytest.raises(InputError, match="d_alpha has values"):
        fresh.gradients(d_colour, np.full_like(d_alpha, np.inf))
