# SPDX-License-Identifier: MIT
"""Inputs of a scene's composition: objects in contact, the ground, the photo and the guidance.

Taichi is imported when an image is rendered, PyTorch when a diffusion model is named."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from ..composite.image_metrics import psnr, ssim
from ..errors import InputError
from ..gaussians.compose.composition_parts import Reference
from ..gaussians.guidance.ideal_denoiser import IdealDenoiser
from ..gaussians.guidance.score_distillation import Guidance
from ..gaussians.splats import Splats
from ..gaussians.views.view_files import read_views
from ..mpm.colliders import Surface
from ..mpm.geometry.inside_test import winding_numbers
from ..mpm.geometry.mesh_checks import check_surface
from ..mpm.geometry.triangles import check_closed, face_normals, validated
from ..scene.folder import Scene
from ..scene.model import Camera, Ground, SceneObject
from ..scene.textured_mesh import TexturedMesh, read_textured_mesh, transformed
from ..srgb import read_mask, read_rgb

Array = NDArray[np.float64]

GROUND_REACH = 0.5
"""Fraction of an object's size; objects higher above the ground cannot be pushed down to it."""

MAX_SUNK = 0.02
"""Fraction of an object's size by which it may reach into the ground and still be supported. Deeper objects were put
there on purpose, and lifting them out would move them away from where the picture shows them."""

SLAB_MARGIN = 0.3
"""Extension of the slab beyond the objects, as a fraction of their extent."""

SLAB_THICKNESS = 0.3
"""Thickness of the slab, as a fraction of the objects' extent."""

_QUADS = ((0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3))


def ground_supports(ground: Ground | None, surface: Surface) -> bool:
    """Return whether the ground is within reach of ``surface``, which does not already lie below it."""
    if ground is None:
        return False
    size = float(np.ptp(surface.vertices, axis=0).max())
    lowest = float(ground.heights(surface.vertices).min())
    return -MAX_SUNK * size <= lowest <= GROUND_REACH * size


def with_ground_slab(surface: Surface, ground: Ground, others: Sequence[Surface]) -> Surface:
    """Return the fixed ``surface`` and a slab of ground below it and ``others`` as one surface of two components.

    They may overlap: inside is the union. The slab is closed and as small as possible, because its distances are
    sampled on a lattice. Its upper face is the ground plane, lowered slightly where ``others`` reach below it.
    """
    normal = ground.unit_normal
    side = np.cross(normal, np.eye(3)[int(np.abs(normal).argmin())])
    side /= np.linalg.norm(side)
    frame = np.stack([side, np.cross(normal, side), normal])
    points = np.concatenate([surface.vertices, *(other.vertices for other in others)]) - np.asarray(ground.point)
    local = points @ frame.T
    extent = float(np.ptp(local, axis=0).max())
    low, high = local.min(axis=0) - SLAB_MARGIN * extent, local.max(axis=0) + SLAB_MARGIN * extent
    reach = np.concatenate([other.vertices for other in others]) - np.asarray(ground.point)
    high[2] = min(0.0, float((reach @ normal).min()))
    low[2] = high[2] - SLAB_THICKNESS * extent
    corners = np.array([[x, y, z] for x in (low[0], high[0]) for y in (low[1], high[1]) for z in (low[2], high[2])])
    faces = np.array([[q[0], q[1], q[2]] for q in _QUADS] + [[q[0], q[2], q[3]] for q in _QUADS])
    return Surface(
        vertices=np.concatenate([surface.vertices, corners @ frame + np.asarray(ground.point)]),
        faces=np.concatenate([surface.faces, faces + len(surface.vertices)]),
    )


def depth_below_ground(ground: Ground | None, surface: Surface) -> float:
    """Return the depth of ``surface`` below the ground in metres; 0 where it is above, or there is no ground."""
    return 0.0 if ground is None else max(0.0, -float(ground.heights(surface.vertices).min()))


GAP_SAMPLES = 20_000
"""Samples on each surface between which the gap is measured."""


@dataclass(frozen=True, kw_only=True, eq=False)
class ComposeObject:
    """An object of the scene with its mesh. mesh: as in the file; surface: the same vertices in world metres."""

    item: SceneObject
    mesh: TexturedMesh
    surface: Surface

    @property
    def name(self) -> str:
        """Return the object's name."""
        return self.item.name

    @property
    def size(self) -> float:
        """Return the longest side of its bounding box in metres."""
        return float(np.ptp(self.surface.vertices, axis=0).max())


@dataclass(frozen=True, kw_only=True, eq=False)
class ContactGroup:
    """Bodies in contact, the fixed one first, then the deformable ones; notes: irregularities of their meshes."""

    bodies: tuple[ComposeObject, ...]
    notes: tuple[str, ...]


def read_compose_object(folder: Scene, item: SceneObject) -> ComposeObject:
    """Return the object ``item`` with its mesh. Raises InputError as ``read_textured_mesh`` does."""
    mesh = read_textured_mesh(folder.file(item.mesh))
    matrix = np.asarray(item.world_from_mesh, dtype=np.float64)
    faces = mesh.faces[:, ::-1] if np.linalg.det(matrix[:3, :3]) < 0 else mesh.faces
    return ComposeObject(
        item=item,
        mesh=mesh,
        surface=Surface(vertices=transformed(mesh.vertices, matrix), faces=faces),
    )


def contact_groups(folder: Scene, names: Sequence[str], *, cells: int) -> tuple[ContactGroup, ...]:
    """Return the objects to compose, in groups in contact.

    names: the fixed object first, then the deformable ones; empty: all that touch another, frontmost first, because
    those are seen unoccluded. cells: bodies are in contact when their gap is below one of ``cells`` cells along both
    together, the reach of the simulation.

    Raises InputError for unknown or repeated names, for fewer than two objects, for one that touches no other (with the
    distance), lies completely inside another or has an open mesh, and for a collider that would have to deform.
    """
    chosen = _selected(folder, names)
    bodies = [read_compose_object(folder, item) for item in chosen]
    gaps = _gaps(bodies)
    near = np.array([[_contact_distance(a, b, cells) for b in bodies] for a in bodies])
    touching = gaps <= near
    np.fill_diagonal(touching, False)
    alone = ~touching.any(axis=1)
    if alone.all() or (names and alone.any()):
        raise InputError(_not_touching(bodies, gaps, int(np.flatnonzero(alone)[0]) if names else None))
    count, label = connected_components(coo_matrix(touching), directed=False)
    if names and count > 1:
        other = int(np.flatnonzero(label != label[0])[0])
        raise InputError(_not_touching([bodies[0], bodies[other]], gaps[np.ix_([0, other], [0, other])], 1))
    found = []
    for number in range(count):
        members = [bodies[i] for i in np.flatnonzero((label == number) & ~alone)]
        if len(members) > 1:
            found.append(_checked_group(members))
    return tuple(found)


def _selected(folder: Scene, names: Sequence[str]) -> list[SceneObject]:
    known = {item.name: item for item in folder.model.objects}
    for name in names:
        if name not in known:
            raise InputError(f"objects: there is no {name!r} in {folder.root}; choose from {', '.join(known)}")
    if len(set(names)) < len(names):
        raise InputError(f"objects: {', '.join(names)}: name every object once")
    if len(names) == 1 or len(known) < 2:
        raise InputError(f"objects: {', '.join(names or known)}: give at least two to compose")
    if names:
        return [known[name] for name in names]
    # Colliders are fixed; of equally near ones the first.
    return sorted(known.values(), key=lambda item: (item.role != "collider", item.occlusion_order))


def _checked_group(bodies: list[ComposeObject]) -> ContactGroup:
    notes: list[str] = []
    for body in bodies:
        notes += check_surface(body.surface, name=f"object {body.name!r}")
    late = [body.name for body in bodies[1:] if body.item.role == "collider" and bodies[0].item.role != "collider"]
    if late:
        raise InputError(f"object {late[0]!r}: is a collider and cannot be deformed; name it first, or make it dynamic")
    for i, a in enumerate(bodies):
        for b in bodies[i + 1 :]:
            for inner, outer in ((a, b), (b, a)):
                if _is_inside(inner.surface, outer.surface):
                    raise InputError(
                        f"object {inner.name!r}: is completely inside {outer.name!r}, so its side is undetermined; "
                        "move it until it is visible, or leave it out"
                    )
    return ContactGroup(bodies=tuple(bodies), notes=tuple(notes))


def _contact_distance(a: ComposeObject, b: ComposeObject, cells: int) -> float:
    low = np.minimum(a.surface.vertices.min(axis=0), b.surface.vertices.min(axis=0))
    high = np.maximum(a.surface.vertices.max(axis=0), b.surface.vertices.max(axis=0))
    # The common extent alone would count bodies as the nearer the farther apart they are.
    return min(float((high - low).max()), a.size + b.size) / cells


def _gaps(bodies: Sequence[ComposeObject]) -> Array:
    """Return approximate gaps (N, N) in metres between the surfaces; 0 where they intersect or contain each other."""
    clouds = [_surface_samples(body.surface) for body in bodies]
    trees = [cKDTree(cloud) for cloud in clouds]
    result = np.zeros((len(bodies), len(bodies)))
    for i, a in enumerate(bodies):
        for j in range(i + 1, len(bodies)):
            b = bodies[j]
            away = float(trees[j].query(clouds[i])[0].min())
            if away > 0 and (_contains(a.surface, clouds[j]).any() or _contains(b.surface, clouds[i]).any()):
                away = 0.0
            result[i, j] = result[j, i] = away
    return result


def _surface_samples(surface: Surface) -> Array:
    """Return vertices and uniform random samples (P, 3) of a surface."""
    corners = surface.vertices[surface.faces]
    area = face_normals(corners)[1]
    random = np.random.default_rng(0)
    weights = area / area.sum() if area.sum() > 0 else None
    which = random.choice(len(corners), size=GAP_SAMPLES, p=weights)
    share = random.dirichlet((1.0, 1.0, 1.0), size=GAP_SAMPLES)
    used = surface.vertices[np.unique(surface.faces)]
    return np.concatenate([used, np.einsum("nk,nkc->nc", share, corners[which])])


def _contains(surface: Surface, places: Array) -> NDArray[np.bool_]:
    """Return which places (N,) are inside; none for an open surface."""
    low, high = surface.vertices.min(axis=0), surface.vertices.max(axis=0)
    result = ((places > low) & (places < high)).all(axis=1)
    if not result.any():
        return result
    points, faces = validated(surface.vertices, surface.faces)
    try:
        oriented = check_closed(faces)
    except InputError:
        return np.zeros(len(places), dtype=np.bool_)
    result[result] = winding_numbers(places[result], points[faces], oriented) != 0
    return result


def _is_inside(inner: Surface, outer: Surface) -> bool:
    return bool(_contains(outer, _surface_samples(inner)).all())


def _not_touching(bodies: Sequence[ComposeObject], gaps: Array, which: int | None) -> str:
    """Return the message on objects without contact: ``which`` of them, or the nearest two."""
    away = gaps + np.diag(np.full(len(bodies), np.inf))
    i = int(away.min(axis=1).argmin()) if which is None else which
    j = int(away[i].argmin())
    return (
        f"objects {bodies[i].name!r} and {bodies[j].name!r} do not touch: they are {length(float(away[i, j]))} apart; "
        "there is nothing to compose. Move them until they touch, or choose others"
    )


def length(metres: float) -> str:
    """Return a length in metres as text, such as ``3.2 cm``."""
    for unit, size in (("m", 1.0), ("cm", 1e-2), ("mm", 1e-3)):
        if metres >= size:
            return f"{metres / size:.3g} {unit}"
    return f"{metres * 1e3:.2g} mm"


MIXED_PIXELS = 2
"""Pixels around an object in which the photo mixes its colours with the background's."""


@dataclass(frozen=True, kw_only=True)
class ImageSimilarity:
    """Similarity of composition and photo over the whole image. psnr: dB; ssim: 1 where equal."""

    psnr: float
    ssim: float


def require_photo(folder: Scene) -> None:
    """Raise InputError where ``folder`` has no photo."""
    if folder.model.photo is None:
        raise InputError(
            f"{folder.root}: this scene has no photo to compare with; use --no-picture, which composes by physics "
            "alone (method ppps)"
        )


def photo_reference(folder: Scene, items: Sequence[SceneObject], *, size: int) -> Reference:
    """Return the scene's photo as reference for the objects ``items``, its longer side at most ``size`` pixels.

    The backdrop is the photo itself, with shadows and other objects, and behind ``items`` the scene's background: so
    only these objects make a difference. Without masks of them it is the background everywhere.

    Raises InputError when the scene has no photo, or images of another size than its camera's.
    """
    require_photo(folder)
    scene = folder.model
    assert scene.photo is not None and scene.background is not None
    photo, background = (read_rgb(folder.file(name)) for name in (scene.photo, scene.background))
    wanted = (scene.camera.height, scene.camera.width, 3)
    for name, picture in ((scene.photo, photo), (scene.background, background)):
        if picture.shape != wanted:
            raise InputError(
                f"{folder.file(name)}: has {picture.shape[1]}x{picture.shape[0]} pixels, the scene's camera "
                f"{wanted[1]}x{wanted[0]}; restore the image"
            )
    masks = [read_mask(folder.file(item.mask)) for item in items if item.mask is not None]
    if len(masks) == len(items) and all(mask.shape == wanted[:2] for mask in masks):
        seen = np.any(masks, axis=0).astype(np.uint8)
        wide = cv2.dilate(seen, np.ones((2 * MIXED_PIXELS + 1, 2 * MIXED_PIXELS + 1), np.uint8)).astype(np.bool_)
        background = np.where(wide[..., None], background, photo)
    camera = scaled_camera(scene.camera, size)
    return Reference(camera=camera, pixels=_resized(photo, camera), backdrop=_resized(background, camera))


def scaled_camera(camera: Camera, size: int) -> Camera:
    """Return ``camera`` scaled down to at most ``size`` pixels on the longer side; same field of view."""
    share = min(1.0, size / max(camera.width, camera.height))
    width, height = max(1, round(camera.width * share)), max(1, round(camera.height * share))
    x, y = width / camera.width, height / camera.height
    return dataclasses.replace(
        camera,
        width=width,
        height=height,
        fx=camera.fx * x,
        cx=camera.cx * x,
        fy=camera.fy * y,
        cy=camera.cy * y,
    )


def _resized(picture: NDArray[np.uint8], camera: Camera) -> NDArray[np.float64]:
    small = cv2.resize(picture.astype(np.float64) / 255.0, (camera.width, camera.height), interpolation=cv2.INTER_AREA)
    return np.asarray(small, dtype=np.float64)


def photo_colours(folder: Scene, places: NDArray[np.floating[Any]]) -> NDArray[np.float64]:
    """Return (N, 3) sRGB colours, 0 to 1, of the photo where ``places`` (N, 3) project, for untextured meshes."""
    scene = folder.model
    assert scene.photo is not None
    photo = read_rgb(folder.file(scene.photo))
    pixels = scene.camera.project(places)[:, :2]
    column = np.clip(np.nan_to_num(pixels[:, 0]), 0, photo.shape[1] - 1).astype(np.int64)
    row = np.clip(np.nan_to_num(pixels[:, 1]), 0, photo.shape[0] - 1).astype(np.int64)
    return photo[row, column].astype(np.float64) / 255.0


def image_similarity(splats: Splats, reference: Reference) -> ImageSimilarity:
    """Return the similarity of the rendered ``splats`` to the reference."""
    # Late: it imports Taichi, which is not needed for the reference alone.
    from ..gaussians.raster.rasteriser import Rasteriser

    seen = Rasteriser().render(splats, reference.camera, background=(0.0, 0.0, 0.0))
    picture = np.clip(seen.colour + (1.0 - seen.alpha[..., None]) * reference.backdrop, 0.0, 1.0).astype(np.float64)
    return ImageSimilarity(psnr=psnr(picture, reference.pixels, peak=1.0), ssim=ssim(picture, reference.pixels))


KINDS = ("exact", "diffusers")


@dataclass(frozen=True, kw_only=True, eq=False)
class NamedGuidance:
    """A guidance given by name. subject: its object, empty: all deformable ones; cameras: its views, () any."""

    guidance: Guidance
    subject: str
    cameras: tuple[Camera, ...] = ()

    def by_object(self, deformable: Sequence[str]) -> dict[str, Guidance]:
        """Return the guidance by the names of those ``deformable`` objects it applies to."""
        return {name: self.guidance for name in deformable if self.subject in ("", name)}


def load_guidance(text: str, prompt: str, *, size: int) -> NamedGuidance | None:
    """Return the guidance ``KIND:FOLDER`` or ``OBJECT=KIND:FOLDER``; None where ``text`` is empty.

    ``exact`` is the ideal denoiser of the images in a views folder with their cameras, scaled to at most ``size``
    pixels on the longer side. ``diffusers`` gets the ``prompt``. Raises InputError for another kind, a folder that is
    missing or unusable, and images of different sizes.
    """
    if not text:
        return None
    subject, mark, rest = text.partition("=")
    if not mark or ":" in subject:
        subject, rest = "", text
    kind, _, name = rest.partition(":")
    if kind not in KINDS or not name:
        raise InputError(
            f"guidance is {text!r}: write exact:FOLDER or diffusers:FOLDER, prefixed by OBJECT= for one object"
        )
    folder = Path(name).expanduser()
    if not folder.exists():
        raise InputError(f"guidance {text!r}: no such folder {folder}; give a local folder, nothing is downloaded")
    if kind == "diffusers":
        from ..gaussians.guidance.diffusers_guidance import DiffusersGuidance, DiffusersOptions

        return NamedGuidance(guidance=DiffusersGuidance(folder, DiffusersOptions(prompt=prompt)), subject=subject)
    views = read_views(folder)
    cameras = tuple(scaled_camera(view.camera, size) for view in views)
    sizes = {(camera.width, camera.height) for camera in cameras}
    if len(sizes) > 1:
        found = ", ".join(f"{width}x{height}" for width, height in sorted(sizes))
        raise InputError(f"guidance {text!r}: its images have different sizes ({found}): make them equal")
    ((width, height),) = sizes
    pictures = np.stack([cv2.resize(view.pixels, (width, height), interpolation=cv2.INTER_AREA) for view in views])
    return NamedGuidance(guidance=IdealDenoiser(pictures, cameras=cameras), subject=subject, cameras=cameras)
