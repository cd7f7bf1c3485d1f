# SPDX-License-Identifier: MIT
"""The photo's background as geometry, and where a moved camera's pixels lie on it.

Without depth, the background is proxy geometry: the ground, an upright backdrop behind it and a bend joining them, so
that lines on the ground do not break where it ends. It is convex towards the camera: from anywhere in front of the
backdrop each pixel sees it once and nothing occludes anything, so the warp has a closed form and tears nothing.

A depth map turned into one mesh has rubber sheets between near and far. Here it is cut where it jumps: each foreground
layer has a silhouette and a smooth depth that continues beyond it, and what it hides belongs to the proxy.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from ..scene.camera_path import level_forward
from ..scene.model import Camera, Ground
from ..smoothstep import smoothstep
from ..srgb import Linear
from .disocclusion import push_pull
from .outpaint import Borders, needed_borders, pixel_grid, resample

FloatArray = NDArray[np.float64]

DEEP = 4.0
"""Distance of the backdrop over that of the farthest object: near enough for a finite horizon, far enough that lines on
the ground stay straight around the objects."""
CLEAR = 1.6
"""Its minimum."""
BEND = 0.35
"""Radius of the bend over the distance of the backdrop."""
ENDLESS = 1e3
"""Rays that miss the proxy end at this many distances of the backdrop, effectively infinity."""


@dataclass(frozen=True, kw_only=True)
class Proxy:
    """Backdrop proxy geometry: ground, upright backdrop, and the bend between them.

    origin: point on the ground below the photo's camera. up, forward: unit vectors; the backdrop faces backward.
    distance: metres along ``forward`` from ``origin`` to the backdrop. bend: radius of the bend in metres.
    """

    origin: FloatArray
    up: FloatArray
    forward: FloatArray
    distance: float
    bend: float

    def hits(self, eye: FloatArray, rays: FloatArray) -> FloatArray:
        """Return the intersections (..., 3), world metres, of rays (..., 3) from ``eye`` (3,) with the proxy."""
        height, ahead = float((eye - self.origin) @ self.up), float((eye - self.origin) @ self.forward)
        rise, run = rays @ self.up, rays @ self.forward
        end = ENDLESS * self.distance / np.maximum(np.linalg.norm(rays, axis=-1), 1e-12)
        with np.errstate(divide="ignore", invalid="ignore"):
            ground = np.where(rise < 0, -height / rise, np.inf)
            wall = np.where(run > 0, (self.distance - ahead) / run, np.inf)
        length = np.minimum(np.minimum(ground, wall), end)
        with np.errstate(invalid="ignore"):
            length = np.where(self._cut(height, ahead, rise, run, length), self._bend(height, ahead, rise, run), length)
        return np.asarray(eye + length[..., None] * rays)

    def _cut(
        self, height: float, ahead: float, rise: FloatArray, run: FloatArray, length: FloatArray
    ) -> NDArray[np.bool_]:
        """Return which rays end in the corner that the bend replaces."""
        over, along = height + length * rise, ahead + length * run
        return (over < self.bend) & (along > self.distance - self.bend)

    def _bend(self, height: float, ahead: float, rise: FloatArray, run: FloatArray) -> FloatArray:
        """Return the length at which rays leave the bend's cylinder: the farther root."""
        a = rise**2 + run**2
        up, out = height - self.bend, ahead - (self.distance - self.bend)
        b, c = up * rise + out * run, up**2 + out**2 - self.bend**2
        return np.asarray((-b + np.sqrt(np.maximum(b * b - a * c, 0.0))) / np.maximum(a, 1e-30))


def make_proxy(
    camera: Camera, ground: Ground, vertices: Sequence[NDArray[np.floating]], distance: float | None = None
) -> Proxy:
    """Return the proxy for the photo's ``camera``; ``vertices`` (V, 3) of the objects, world metres.

    distance: of the backdrop, metres; None puts it behind all visible ground, or, where the ground reaches the horizon,
    at ``DEEP`` times the farthest object.
    """
    up = ground.unit_normal
    turn = np.asarray(camera.world_from_camera, dtype=np.float64)[:3, :3]
    forward = level_forward(turn, up)
    height = float(ground.heights(camera.position))
    origin = camera.position - height * up
    farthest = max(float(((np.asarray(v) - origin) @ forward).max()) for v in vertices)
    farthest = max(farthest, 0.5 * height)
    if distance is None:
        distance = min(max(2.0 * _seen_ground(camera, up, forward, height), CLEAR * farthest), DEEP * farthest)
    return Proxy(origin=origin, up=up, forward=forward, distance=distance, bend=BEND * distance)


def _seen_ground(camera: Camera, up: FloatArray, forward: FloatArray, height: float) -> float:
    """Return the distance along ``forward`` of the farthest visible ground; infinite if the horizon is visible."""
    x = np.array([0.0, camera.width])
    corners = np.stack(np.meshgrid(x, [0.0, float(camera.height)]), axis=-1).reshape(-1, 2)
    rays = camera.rays(corners)
    rise, run = rays @ up, rays @ forward
    with np.errstate(divide="ignore"):
        return float(np.where(rise < 0, -height * run / rise, np.inf).max())


Mask = NDArray[np.bool_]

GROUND_SHARE = 0.06
"""Depth within this share of the proxy's counts as the proxy: depth maps are no more exact, and nothing may float."""
JUMP = 1.08
"""Ratio of neighbouring depths at which a surface ends."""
SMALLEST = 0.0005
"""Share of the image below which a part is merged into its neighbour."""
MOST = 16
ROUNDS = 12
"""Fixed-point iterations of the warp; each leaves about a tenth of the error."""


@dataclass(frozen=True)
class LayerView:
    """A foreground layer seen by a camera: canvas positions of its pixels (h, w, 2), cover (h, w), mean depth in m."""

    at: NDArray[np.float32]
    cover: NDArray[np.float32]
    depth: float


@dataclass(frozen=True, kw_only=True)
class ForegroundLayer:
    """A surface in front of the proxy, on the canvas.

    cover: (H, W) 0 to 1. depth: (H, W) metres along the photo camera's axis, continued beyond the silhouette.
    """

    cover: NDArray[np.float32]
    depth: NDArray[np.float32]

    def seen(self, photo: Camera, camera: Camera, pixels: NDArray[np.float64], shift: NDArray[np.float64]) -> LayerView:
        """Return its view from ``camera`` at ``pixels`` (h, w, 2); ``shift`` (2,) is the photo's offset on the canvas.

        By fixed-point iteration: guess the photo position, project it into the camera, correct by the difference.
        """
        middle = float(np.median(self.depth[self.cover > 0.5]))
        # First guess: a plane across the photo camera's axis.
        at = photo.project(_on_plane(photo, camera, pixels, middle))[..., :2]
        at = np.where(np.isfinite(at), at, -1e4)
        for _ in range(ROUNDS):
            depth = resample(self.depth, (at + shift).astype(np.float32))
            back = camera.project(photo.position + depth[..., None] * photo.rays(at))
            at = at + np.clip(pixels - back[..., :2], -200.0, 200.0)
        where = (at + shift).astype(np.float32)
        # Where the iteration has not converged, the surface faces away from the camera and is not visible.
        settled = np.linalg.norm(pixels - back[..., :2], axis=-1) < 1.0
        inside = np.asarray((where >= 0).all(-1) & (where[..., 0] <= self.cover.shape[1]) & (back[..., 2] > 0))
        cover = np.where(settled & inside, resample(self.cover, where), 0.0).astype(np.float32)
        return LayerView(at=where, cover=cover, depth=middle)


def _on_plane(photo: Camera, camera: Camera, pixels: NDArray[np.float64], depth: float) -> NDArray[np.float64]:
    """Return world points (..., 3) at ``depth`` of the photo's camera that ``camera`` sees at ``pixels`` (..., 2)."""
    axis = np.asarray(photo.world_from_camera, dtype=np.float64)[:3, 2]
    rays = camera.rays(pixels)
    with np.errstate(divide="ignore", invalid="ignore"):
        length = (depth - (camera.position - photo.position) @ axis) / (rays @ axis)
    return np.asarray(camera.position + length[..., None] * rays)


def proxy_depth(proxy: Proxy, photo: Camera, borders: Borders) -> NDArray[np.float64]:
    """Return the proxy's depth (H, W) on the canvas, metres along the axis of ``photo`` (at the frames' size)."""
    size = (photo.width + borders.left + borders.right, photo.height + borders.top + borders.bottom)
    pixels = pixel_grid(size) - np.array([borders.left, borders.top], dtype=np.float64)
    return np.asarray(photo.project(proxy.hits(photo.position, photo.rays(pixels)))[..., 2])


@dataclass(frozen=True, kw_only=True)
class DepthLayers:
    """A depth map split into layers, on the canvas.

    layers: in front of the proxy. hidden: (H, W), where they are. ratio: (H, W), depth behind them over
    the proxy's.
    """

    layers: tuple[ForegroundLayer, ...]
    hidden: Mask
    ratio: NDArray[np.float32]


def split_depth(
    depth: NDArray[np.floating], objects: Mask, proxy: Proxy, photo: Camera, borders: Borders
) -> DepthLayers:
    """Return the foreground layers of ``depth`` (h, w) and the background behind them.

    depth: of the photo, metres along the axis; unknown where not finite or not above 0. objects: (h, w), the scene's
    own objects, which are not background.
    """
    base = proxy_depth(proxy, photo, borders)
    inner = borders.inner((photo.width, photo.height))
    known = np.isfinite(depth) & (depth > 0)
    own = cv2.dilate(objects.astype(np.uint8), np.ones((5, 5), np.uint8)) > 0
    # Unknown depth, and depth under the objects, is the proxy's.
    flat = np.where(known & ~own, depth, base[inner])
    foreground = flat < (1.0 - GROUND_SHARE) * base[inner]
    parts = _parts(foreground, flat)
    shape = base.shape
    found, where = [], np.zeros(shape, dtype=bool)
    for part in parts:
        cover = np.asarray(borders.padded(part))
        # A layer that touches the photo's border continues beyond it.
        where |= cover
        distance, (rows, columns) = ndimage.distance_transform_edt(~cover, return_indices=True)
        spread = np.asarray(borders.padded(np.where(part, flat, 0.0)))[rows, columns]
        soft = cv2.GaussianBlur(spread.astype(np.float32), (0, 0), 3.0)
        smooth = np.where(distance > 0, soft, spread)
        edge = cv2.GaussianBlur(cover.astype(np.float32), (3, 3), 0.8)
        found.append(ForegroundLayer(cover=edge.astype(np.float32), depth=smooth.astype(np.float32)))
    # Background off the proxy, such as a nearer wall, has its own depth; blended in smoothly, because a step would tear
    # the surface.
    share = np.where(foreground, 1.0, flat / base[inner])
    away = smoothstep(np.abs(share - 1.0), GROUND_SHARE / 2, GROUND_SHARE * 1.5)
    wanted = (1.0 + (share - 1.0) * away).astype(np.float32)
    behind = push_pull(np.repeat(wanted[..., None], 3, axis=-1), ~(foreground | own))[..., 0]
    return DepthLayers(layers=tuple(found), hidden=where, ratio=np.asarray(borders.padded(behind), dtype=np.float32))


def _parts(foreground: Mask, depth: NDArray[np.floating]) -> list[Mask]:
    """Return ``foreground`` (h, w) split where ``depth`` jumps; small parts are merged into the nearest large one."""
    kernel = np.ones((3, 3), np.uint8)
    values = depth.astype(np.float32)
    jumps = cv2.dilate(values, kernel) > JUMP * cv2.erode(values, kernel)
    count, labels, stats, _ = cv2.connectedComponentsWithStats((foreground & ~jumps).astype(np.uint8), connectivity=4)
    areas = stats[1:count, cv2.CC_STAT_AREA]
    large = [int(i) + 1 for i in np.argsort(areas)[::-1][:MOST] if areas[i] >= SMALLEST * foreground.size]
    if not large:
        return []
    keep = np.isin(labels, large)
    rows, columns = ndimage.distance_transform_edt(~keep, return_indices=True)[1]
    owner = np.where(foreground, labels[rows, columns], 0)
    return [np.asarray(owner == label) for label in large]


COARSE = 33
"""Points per side at which a view's extent beyond the photo is tested."""


@dataclass(frozen=True, kw_only=True)
class Backdrop:
    """The photo's background as seen by ``camera`` (at the frames' size): a proxy and foreground layers, on a canvas.

    borders: outpainted around the photo.
    hidden: (H, W) on the canvas, where foreground layers are; behind: (H, W, 3), the colours behind them; None without.
    ratio: (H, W) on the canvas, distance of the background behind the layers over the proxy's; None: it is the proxy.
    """

    camera: Camera
    proxy: Proxy
    borders: Borders
    layers: tuple[ForegroundLayer, ...] = ()
    hidden: NDArray[np.bool_] | None = None
    behind: Linear | None = None
    ratio: NDArray[np.float32] | None = None

    def warp(self, camera: Camera) -> Warp:
        """Return the warp into ``camera`` (at the frames' size as well)."""
        pixels = pixel_grid((camera.width, camera.height))
        shift = np.array([self.borders.left, self.borders.top], dtype=np.float64)
        at = on_photo(self.proxy, self.camera, camera, pixels)
        if self.ratio is not None:
            at = self._corrected(camera, pixels, at, self.ratio, shift)
        base = (at + shift).astype(np.float32)
        layers = [layer.seen(self.camera, camera, pixels, shift) for layer in self.layers]
        return Warp(backdrop=self, camera=camera, base=base, layers=tuple(sorted(layers, key=lambda s: -s.depth)))

    def _corrected(
        self,
        camera: Camera,
        pixels: NDArray[np.float64],
        at: NDArray[np.float64],
        ratio: NDArray[np.float32],
        shift: NDArray[np.float64],
    ) -> NDArray[np.float64]:
        """Return the photo positions (h, w, 2) of ``camera``'s ``pixels``, starting from ``at`` on the proxy.

        By fixed-point iteration. Where ``ratio`` is 1 the start is right and stays exactly.
        """
        eye = self.camera.position
        for _ in range(ROUNDS):
            away = self.proxy.hits(eye, self.camera.rays(at)) - eye
            scale = resample(ratio, (at + shift).astype(np.float32))[..., None]
            back = camera.project(eye + scale * away)
            at = at + np.clip(pixels - back[..., :2], -100.0, 100.0)
        return at


@dataclass(frozen=True)
class Warp:
    """One camera's view of a backdrop."""

    backdrop: Backdrop
    camera: Camera
    base: NDArray[np.float32]
    layers: Sequence[LayerView]

    def colours(self, image: Linear) -> Linear:
        """Return canvas colours ``image`` (H, W, 3) as the camera sees them (h, w, 3)."""
        hidden, behind = self.backdrop.hidden, self.backdrop.behind
        if hidden is None or behind is None:
            return self._layered(image, image)
        return self._layered(image, np.where(hidden[..., None], behind, image))

    def values(self, image: NDArray[Any]) -> NDArray[Any]:
        """Return canvas weights, light or masks ``image`` (H, W, …) as the camera sees them (h, w, …)."""
        return self._layered(image, image)

    def _layered(self, image: NDArray[Any], behind: NDArray[Any]) -> NDArray[Any]:
        seen = resample(behind, self.base)
        for layer in self.layers:
            found = resample(image, layer.at)
            if seen.dtype == np.bool_:
                seen = np.where(layer.cover > 0.5, found, seen)
            else:
                cover = layer.cover if seen.ndim == 2 else layer.cover[..., None]
                seen = (seen + (found - seen) * cover).astype(np.float32)
        return seen

    def photo_pixels(self, pixels: NDArray[np.floating]) -> NDArray[np.float64]:
        """Return the photo positions (..., 2) of the proxy at the camera's ``pixels`` (..., 2); NaN stays NaN."""
        return on_photo(self.backdrop.proxy, self.backdrop.camera, self.camera, pixels)


def on_photo(proxy: Proxy, photo: Camera, camera: Camera, pixels: NDArray[np.floating]) -> NDArray[np.float64]:
    """Return the pixels (..., 2) of ``photo`` that show the proxy at ``camera``'s ``pixels``; NaN behind the camera."""
    found = photo.project(proxy.hits(camera.position, camera.rays(pixels)))
    return np.where(found[..., 2:] > 1e-6, found[..., :2], np.nan)


def borders_of(proxy: Proxy, photo: Camera, views: Sequence[tuple[str, Camera]]) -> Borders:
    """Return borders that contain all named ``views`` at the frames' size. Raises InputError if one is too wide."""
    edge = pixel_grid((photo.width, photo.height), COARSE)
    return needed_borders(
        ((name, on_photo(proxy, photo, camera, edge)) for name, camera in views), (photo.width, photo.height)
    )
