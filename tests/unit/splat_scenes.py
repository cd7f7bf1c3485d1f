# SPDX-License-Identifier: MIT
"""Two objects of known shape, and what cameras around them see: rays meet spheres and boxes by their formulas."""

from __future__ import annotations

import numpy as np
from physgen.sim.gaussians.views.posed_images import View, orbit_camera

RED, BLUE = np.array([0.85, 0.2, 0.15]), np.array([0.15, 0.25, 0.8])


class Ball:
    """A sphere."""

    def __init__(self, middle, radius):
        self.middle, self.radius = np.asarray(middle, dtype=float), radius

    def depth(self, origin, rays):
        """(...) how far along ``rays`` (..., 3) it is met; infinite where it is not."""
        off = origin - self.middle
        a, b, c = (rays**2).sum(-1), rays @ off, off @ off - self.radius**2
        root = b**2 - a * c
        return np.where(root > 0, (-b - np.sqrt(np.maximum(root, 0))) / a, np.inf)

    def distance(self, points):
        """(n) signed distance of ``points`` (n, 3), below 0 inside."""
        return np.linalg.norm(points - self.middle, axis=1) - self.radius


class Box:
    """A box along the axes."""

    def __init__(self, low, high):
        self.low, self.high = np.asarray(low, dtype=float), np.asarray(high, dtype=float)

    def depth(self, origin, rays):
        with np.errstate(divide="ignore"):
            ends = np.stack([(self.low - origin) / rays, (self.high - origin) / rays])
        enter, leave = ends.min(axis=0).max(axis=-1), ends.max(axis=0).min(axis=-1)
        return np.where((enter < leave) & (enter > 0), enter, np.inf)

    def distance(self, points):
        off = np.abs(points - (self.low + self.high) / 2) - (self.high - self.low) / 2
        return np.linalg.norm(np.maximum(off, 0), axis=1) + np.minimum(off.max(axis=1), 0)


class Ring:
    """A torus around the z axis."""

    def __init__(self, radius, thickness, height=0.0):
        self.radius, self.thickness, self.height = radius, thickness, height

    def depth(self, origin, rays):
        """By steps of the distance, which never step through a surface."""
        unit = rays / np.linalg.norm(rays, axis=-1, keepdims=True)
        flat = unit.reshape(-1, 3)
        far = np.full(len(flat), max(0.0, np.linalg.norm(origin) - 2 * self.radius))
        for _ in range(80):
            far += self.distance(origin + far[:, None] * flat)
        found = np.where(np.abs(self.distance(origin + far[:, None] * flat)) < 1e-3, far, np.inf)
        return found.reshape(rays.shape[:-1]) / np.linalg.norm(rays, axis=-1)

    def distance(self, points):
        around = np.hypot(points[:, 0], points[:, 1]) - self.radius
        return np.hypot(around, points[:, 2] - self.height) - self.thickness


def cameras(count=16, side=96):
    """Cameras all around, at three heights, so that a hull has a top and a bottom."""
    heights = (35.0, -20.0, 5.0)
    return [orbit_camera(360 * i / count, heights[i % 3], 2.5, side=side, focal=1.2) for i in range(count)]


def seen(solids, camera, samples=3):
    """(H, W, 3) colours before white, (H, W) mask and (H, W) labels of ``solids``, the background object first."""
    steps = (np.arange(samples) + 0.5) / samples
    rows, columns = np.arange(camera.height), np.arange(camera.width)
    y, x = (rows[:, None] + steps).ravel(), (columns[:, None] + steps).ravel()
    rays = camera.rays(np.stack(np.meshgrid(x, y), axis=-1))
    depths = np.stack([solid.depth(camera.position, rays) for solid in solids])
    first = np.where(np.isfinite(depths.min(axis=0)), depths.argmin(axis=0), len(solids))
    blocks = first.reshape(camera.height, samples, camera.width, samples).transpose(0, 2, 1, 3)
    shares = np.stack([(blocks == i).mean(axis=(2, 3)) for i in range(len(solids) + 1)], axis=-1)
    colours = shares @ np.array([RED, BLUE, *[[1.0, 1.0, 1.0]] * len(solids)])[[*range(len(solids)), -1]]
    mask = 1 - shares[..., -1]
    labels = np.where(mask >= 0.5, shares[..., :-1].argmax(axis=-1) + 1, -1)
    return colours, mask, labels


def views_of(solids, count=16, side=96):
    found = []
    for index, camera in enumerate(cameras(count, side)):
        colours, mask, labels = seen(solids, camera)
        found.append(View(name=f"v{index}", camera=camera, pixels=colours, mask=mask, labels=labels))
    return found
