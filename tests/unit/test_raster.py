# SPDX-License-Identifier: MIT
"""The rasteriser of splats against a plain double precision one, and its gradients against finite differences of it."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from physgen.sim.errors import InputError
from physgen.sim.gaussians.raster import tiles
from physgen.sim.gaussians.raster.rasteriser import Rasteriser
from physgen.sim.gaussians.splats import Splats
from physgen.sim.mpm.options import SolverOptions
from physgen.sim.scene.model import Camera
from scipy.spatial.transform import Rotation

NAMES = ("centres", "scales", "rotations", "opacities", "colours")
BACKGROUND = (0.3, 0.6, 0.9)


@pytest.fixture(scope="module")
def rasteriser():
    return Rasteriser()


def camera(width=37, height=29, *, distance=1.0, fx=45.0, fy=38.0, cx=16.0, cy=17.5):
    """From ``distance`` in front of the world's origin, tilted; both focal lengths and the middle are odd on purpose."""
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_euler("xyz", (-80, 7, 20), degrees=True).as_matrix()
    pose[:3, 3] = -distance * pose[:3, 2]
    return Camera(width=width, height=height, fx=fx, fy=fy, cx=cx, cy=cy, world_from_camera=pose)


def scene(seed, count=40):
    """Splats of all sizes and shapes, dim to opaque, around the origin: some beyond the picture, some behind it."""
    random = np.random.default_rng(seed)
    return Splats(
        centres=random.normal(size=(count, 3)) * (0.35, 0.6, 0.35),
        scales=np.exp(random.uniform(np.log(0.005), np.log(0.4), (count, 3))),
        rotations=random.normal(size=(count, 4)),
        opacities=np.where(np.arange(count) % 5 == 0, 1.0 - 10.0 ** random.uniform(-4, -2, count), 0)
        + np.where(np.arange(count) % 5 != 0, random.uniform(0.02, 0.95, count), 0),
        colours=random.uniform(0, 1, (count, 3)),
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


@pytest.mark.parametrize("seed", range(4))
def test_the_picture_is_that_of_the_formulas(rasteriser, seed):
    splats, view = scene(seed, 120), camera()
    found = rasteriser.render(splats, view, background=BACKGROUND)
    colour, alpha, depth = plain(splats, view)
    np.testing.assert_allclose(found.colour, colour, atol=2e-5)
    np.testing.assert_allclose(found.alpha, alpha, atol=2e-5)
    np.testing.assert_allclose(found.depth, depth, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("name", NAMES)
def test_gradients_are_those_of_finite_differences(rasteriser, seed, name):
    """Of each kind of number: the whole gradient against central differences of the plain picture."""
    splats, view = scene(seed), camera()
    random = np.random.default_rng(seed)
    d_colour, d_alpha = random.normal(size=(29, 37, 3)), random.normal(size=(29, 37))
    rasteriser.render(splats, view, background=BACKGROUND)
    found = getattr(rasteriser.gradients(d_colour, d_alpha), name)

    def loss(changed):
        colour, alpha, _ = plain(changed, view)
        return np.sum(colour * d_colour) + np.sum(alpha * d_alpha)

    wanted = np.zeros_like(found)
    for index in np.ndindex(*found.shape):
        step = 1e-6 * (float(splats.scales[index[0]].min()) if name in ("centres", "scales") else 1.0)
        wanted[index] = (loss(raised(splats, name, index, step)) - loss(raised(splats, name, index, -step))) / (
            2 * step
        )
    worst = np.abs(found - wanted).max(axis=-1) / np.abs(wanted).max()
    print(name, seed, np.linalg.norm(found - wanted) / np.linalg.norm(wanted), worst.max())
    assert np.linalg.norm(found - wanted) < 1e-3 * np.linalg.norm(wanted)
