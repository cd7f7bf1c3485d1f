# SPDX-License-Identifier: MIT
"""Estimate the appearance of each object: albedo, roughness and metallic, and where each comes from."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.spatial import cKDTree

from ...scene.equirectangular import Radiance
from ...scene.model import Camera, Light
from ...srgb import bytes_to_linear
from ..creases import CreasedSurface, split_creases
from ..mesh_raster import seen_faces, visible_pixels
from ..photo_layers import Layers
from ..reasoning.material_decision import ObjectPhysics
from ..reconstruct_options import ObjectRequest
from ..shape.body_texture import TexturedSurface
from ..shape.object_bodies import Body
from ..shape.object_placement import TriangleMesh
from ..stage_cache import Arrays, Notice, StageCache, Steps
from .albedo import NEAR, compute_albedo, texel_values
from .object_shading import DIELECTRIC_F0, LocalLighting, Mesh, Shading, local_lighting, shade, sky_lobe, sun_lobe
from .reflectance_fit import FitPixels, Reflectance, fit_reflectance

Mask = NDArray[np.bool_]
Pixels = NDArray[np.uint8]

MAX_PLACES = 20_000
"""Largest number of shaded points; a larger surface interpolates from the nearest."""
FIT_PIXELS = 3000
GRAZING = 0.25
"""Cosine between normal and line of sight below which a pixel's normal is too uncertain."""
CLIPPED = 250
WIDE = 0.5
"""Roughness from which a reflection is too blurred to be misplaced."""
DEFAULT_ROUGHNESS, DEFAULT_METALLIC = 0.6, 0.0


@dataclass(frozen=True)
class Appearance:
    """roughness, metallic: 0 to 1, of a glTF material. source: "fitted" to the photo, "class" of its material, or
    "default". note: the reason, in words."""

    roughness: float
    metallic: float
    source: str
    note: str


def estimate_appearance(
    view: Camera,
    surface: TexturedSurface,
    seen: Mask,
    pixels: Pixels,
    background: Pixels,
    others: Sequence[Mesh],
    radiance: Radiance,
    light: Light,
    physics: ObjectPhysics,
    notice: Callable[[str], None],
    name: str,
) -> tuple[Appearance, Pixels]:
    """Return the appearance of the object ``name``, and its albedo (h, w, 3) sRGB, in the layout of the texture of
    ``surface``.

    seen: (H, W) visible pixels; pixels, background: (H, W, 3) sRGB, the photo with and without objects and shadows.
    others: surfaces of the other objects. radiance: the environment of ``light``. Lengths in the unit of ``view``,
    above z = 0. Undetermined values come from the material class.
    """
    vertices = np.asarray(surface.vertices, dtype=np.float64)
    shape = split_creases(vertices, surface.faces)
    size = float(np.ptp(vertices, axis=0).max())
    middle = vertices.mean(axis=0) * (1.0, 1.0, 0.0)
    scene = local_lighting(view, bytes_to_linear(background), middle, size, radiance, light)
    picture = bytes_to_linear(surface.picture).astype(np.float64) / scene.white
    colour = np.clip(np.median(picture.reshape(-1, 3), axis=0) * 1.3, 0.03, 0.8)
    shading = _shaded(scene, shape, (vertices, surface.faces), others, colour)
    found = _fitted(view, scene, shape, shading, seen, pixels)
    appearance = _chosen(found, physics)
    notice(_in_words(name, appearance))
    facing = seen_faces(view, shape.vertices, shape.faces)
    height, width = surface.picture.shape[:2]
    # Eleven numbers per vertex, unpacked by ``_geometry``.
    values = np.column_stack([shading.total, shape.normals, shading.reached, shading.openness, shape.vertices])
    texels, covered = texel_values(shape, surface.uv, facing, values, (width, height))
    if appearance.metallic > 0.5:
        mirrored = _where_shaded(texels, covered, lambda some: _mirrored(view, scene, some))
        albedo, exponent = compute_albedo(picture, mirrored, None, covered)
    else:
        fitted = found if appearance.source == "fitted" and not isinstance(found, str) else None
        roughness = appearance.roughness
        highlight = _where_shaded(texels, covered, lambda some: _reflected(view, scene, some, roughness, fitted))
        albedo, exponent = compute_albedo(picture, texels[..., :3], highlight, covered)
    if exponent < 1.0:
        notice(
            f"{name}: divided by its shading, points of one colour would differ more than in the photo, so the light, "
            f"the shape or the material is wrong; divided by its power {exponent:.2g} only"
        )
    return appearance, albedo


def _shaded(
    scene: LocalLighting,
    shape: CreasedSurface,
    own: Mesh,
    others: Sequence[Mesh],
    colour: NDArray[np.float64],
) -> Shading:
    count = len(shape.vertices)
    if count <= MAX_PLACES:
        return shade(scene, shape.vertices, shape.normals, own, others, colour)
    chosen = np.random.default_rng(0).permutation(count)[:MAX_PLACES]
    size = max(float(np.ptp(shape.vertices, axis=0).max()), 1e-12)
    features = np.column_stack([shape.vertices / size, 0.2 * shape.normals])
    nearest = cKDTree(features[chosen]).query(features)[1]
    some = shade(scene, shape.vertices[chosen], shape.normals[chosen], own, others, colour)
    return Shading(some.ambient[nearest], some.sun[nearest], some.reached[nearest], some.openness[nearest])


def _views(view: Camera, places: NDArray[np.float64]) -> NDArray[np.float64]:
    towards = view.position - places
    return np.asarray(towards / np.maximum(np.linalg.norm(towards, axis=1, keepdims=True), 1e-12))


def _fitted(
    view: Camera, scene: LocalLighting, shape: CreasedSurface, shading: Shading, seen: Mask, pixels: Pixels
) -> Reflectance | str:
    scale = min(1.0, float(np.sqrt(FIT_PIXELS / max(int(seen.sum()), 1))))
    size = (max(1, round(view.width * scale)), max(1, round(view.height * scale)))
    shown = visible_pixels(view, shape.vertices, shape.faces, scale)

    def small(picture: NDArray[np.float32]) -> NDArray[np.float64]:
        return np.asarray(cv2.resize(picture, size, interpolation=cv2.INTER_AREA), dtype=np.float64)

    inside = ndimage.binary_erosion(small(seen.astype(np.float32)) > 0.999)
    brightness = small(bytes_to_linear(pixels))
    clipped = small((pixels.max(axis=2) >= CLIPPED).astype(np.float32)) > 0.2
    values = np.column_stack([shape.normals, shape.vertices, shading.ambient, shading.sun, shading.reached])
    values = np.column_stack([values, shading.openness])
    there = shown.interpolated(shape.faces, values)
    normals = there[:, :3] / np.maximum(np.linalg.norm(there[:, :3], axis=1, keepdims=True), 1e-9)
    views = _views(view, there[:, 3:6])
    use = inside[shown.rows, shown.columns] & ((normals * views).sum(axis=1) > GRAZING)
    rows, columns = shown.rows[use], shown.columns[use]
    return fit_reflectance(
        scene,
        FitPixels(
            brightness=brightness[rows, columns] / scene.white,
            clipped=clipped[rows, columns],
            normals=normals[use],
            views=views[use],
            ambient=there[use, 6:9],
            sun=there[use, 9],
            reached=there[use, 10],
            openness=there[use, 11],
        ),
    )


def _where_shaded(
    texels: NDArray[np.float64],
    covered: Mask,
    light: Callable[[NDArray[np.float64]], NDArray[np.float64]],
) -> NDArray[np.float64]:
    """``light`` (h, w, 3) of ``texels`` (h, w, 11), computed once for those, all alike, that are far from what
    visible faces cover (h, w): most of a texture shows the unseen side."""
    side = 2 * NEAR + 3
    near = cv2.dilate(covered.astype(np.uint8), np.ones((side, side), np.uint8)) > 0
    far = np.argwhere(~near)
    if not len(far):
        return light(texels)
    result = np.empty((*covered.shape, 3))
    result[~near] = light(texels[None, far[0][0], far[0][1], :][None])[0, 0]
    result[near] = light(texels[near][None])[0]
    return result


def _reflected(
    view: Camera, scene: LocalLighting, texels: NDArray[np.float64], roughness: float, fitted: Reflectance | None
) -> NDArray[np.float64]:
    """Brightness (h, w, 3) reflected by varnish at texels (h, w, 11), see ``estimate_appearance``.

    The position of an undetected highlight is unknown, so it is left out unless it is wide.
    """
    normals, views, reached, openness = _geometry(view, texels)
    sky = sky_lobe(scene, normals, views, roughness, DIELECTRIC_F0) * openness[:, None]
    disc = None if fitted is None else fitted.disc
    sun = np.zeros(len(sky))
    if scene.sun is not None and (fitted is not None or roughness >= WIDE):
        sun = sun_lobe(scene, normals, views, roughness, DIELECTRIC_F0, disc) * reached
    strength = 1.0 if fitted is None else fitted.strength
    return np.asarray(strength * (sun[:, None] + sky)).reshape(*texels.shape[:2], 3)


def _mirrored(view: Camera, scene: LocalLighting, texels: NDArray[np.float64]) -> NDArray[np.float64]:
    """Brightness (h, w, 3) of a white metal at texels (h, w, 11), too rough to mirror details."""
    normals, views, reached, openness = _geometry(view, texels)
    light = sky_lobe(scene, normals, views, WIDE, 1.0) * openness[:, None]
    if scene.sun is not None:
        light = light + (sun_lobe(scene, normals, views, WIDE, 1.0) * reached)[:, None]
    return np.asarray(light).reshape(*texels.shape[:2], 3)


def _geometry(view: Camera, texels: NDArray[np.float64]) -> tuple[NDArray[np.float64], ...]:
    flat = texels.reshape(-1, texels.shape[2])
    normals = flat[:, 3:6] / np.maximum(np.linalg.norm(flat[:, 3:6], axis=1, keepdims=True), 1e-9)
    return normals, _views(view, flat[:, 8:11]), flat[:, 6], flat[:, 7]


def _chosen(found: Reflectance | str, physics: ObjectPhysics) -> Appearance:
    metallic = physics.metallic
    if not isinstance(found, str) and (found.metal or not (metallic or 0.0) > 0.5):
        if found.metal:
            return Appearance(found.roughness, 1.0, "fitted", f"a mirror of its colour explains {found.gain:.0%}")
        return Appearance(
            found.roughness, 0.0, "fitted", f"a highlight {found.strength:.2g} times that of plain varnish"
        )
    why = found if isinstance(found, str) else "its highlight was fitted as a dielectric's, but it is a metal"
    if physics.appearance_roughness is None and metallic is None:
        return Appearance(DEFAULT_ROUGHNESS, DEFAULT_METALLIC, "default", why)
    roughness = DEFAULT_ROUGHNESS if physics.appearance_roughness is None else physics.appearance_roughness
    return Appearance(roughness, DEFAULT_METALLIC if metallic is None else metallic, "class", why)


def _in_words(name: str, appearance: Appearance) -> str:
    values = f"roughness {appearance.roughness:.2g}, metallic {appearance.metallic:.2g}"
    if appearance.source == "fitted":
        return f"{name}: {values}, fitted to the photo ({appearance.note})"
    whose = "as usual for its material" if appearance.source == "class" else "by default"
    return f"{name}: {values} {whose}, undetermined by the photo ({appearance.note})"


@dataclass(frozen=True)
class ObjectAppearance:
    """albedo: (h, w, 3) uint8 sRGB, in the layout of the body's texture. roughness, metallic: of its shader, 0 to 1."""

    albedo: NDArray[np.uint8]
    roughness: float
    metallic: float


def estimate_appearances(
    layers: Layers,
    view: Camera,
    bodies: Sequence[Body],
    objects: Sequence[ObjectRequest],
    physics: Sequence[ObjectPhysics],
    radiance: Radiance,
    light: Light,
    store: StageCache,
    steps: Steps,
) -> list[ObjectAppearance]:
    """Return albedo, roughness and metallic of each of the ``bodies``, lit by ``radiance`` and the sun of ``light``."""
    looks = []
    for i, item in enumerate(objects):
        steps.begin(f"look of {item.name}")
        surface = bodies[i].surface
        others = [(body.surface.vertices, body.surface.faces) for j, body in enumerate(bodies) if j != i]
        inputs = {
            "pixels": layers.colours[i],
            "seen": layers.seen[i],
            "background": layers.background,
            "surface": [surface.vertices, surface.faces, surface.uv, surface.picture],
            "others": others,
            "radiance": radiance,
            "light": light,
            "view": view,
            "known": [item.name, physics[i].metallic, physics[i].appearance_roughness],
        }

        def look(
            notice: Notice, i: int = i, surface: TexturedSurface = surface, others: list[TriangleMesh] = others
        ) -> Arrays:
            appearance, albedo = estimate_appearance(
                view,
                surface,
                layers.seen[i],
                layers.colours[i],
                layers.background,
                others,
                radiance,
                light,
                physics[i],
                notice,
                objects[i].name or "",
            )
            return {"albedo": albedo, "numbers": np.array([appearance.roughness, appearance.metallic])}

        made = store.run("look", inputs, look)
        roughness, metallic = (float(v) for v in made["numbers"])
        looks.append(ObjectAppearance(made["albedo"], roughness, metallic))
    return looks
