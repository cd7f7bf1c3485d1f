# SPDX-License-Identifier: MIT
"""Scene folder → another in which objects no longer penetrate each other (docs/composition.md).

What moved is written anew, everything else is shared with the source scene; ``compose.json`` records what was done."""

from __future__ import annotations

import dataclasses
import math
import os
import platform
import shutil
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..atomic import write_json
from ..errors import Cancelled, InputError
from ..events import IsCancelled, OnEvent, ignore, never
from ..gaussians.compose import composition
from ..gaussians.compose.compose_options import ComposeRequest
from ..gaussians.compose.composition_parts import Composition, CompositionPart, Reference
from ..gaussians.compose.penetration import Penetration, penetration_of_meshes
from ..gaussians.mesh_to_splats import Texture, splats_on_mesh
from ..gaussians.splat_ply import read_splats, write_splats
from ..gaussians.splats import Splats, joined, transform_splats
from ..memory import COMPOSITION_RESERVED, available_memory, composition_bytes, require_memory
from ..mpm.colliders import Surface
from ..mpm.geometry.triangles import face_normals
from ..scene.folder import Scene, inside, referenced_files, save_scene, unchanged_scene
from ..scene.model import Ground, SceneModel, SceneObject
from ..scene.scene_output import COMPOSE_FILE, PHYSICS_FILE, replacing_folder
from ..scene.textured_mesh import moved_suffix, transformed, write_moved_mesh
from ..version import VERSION
from .compose_inputs import (
    ComposeObject,
    ContactGroup,
    ImageSimilarity,
    NamedGuidance,
    contact_groups,
    depth_below_ground,
    ground_supports,
    image_similarity,
    length,
    load_guidance,
    photo_colours,
    photo_reference,
    require_photo,
    with_ground_slab,
)

Array = NDArray[np.float64]

UNNAMED_FILES = ("masks", "full", "shadows", "holes", "albedo", PHYSICS_FILE)
"""Files of a scene that ``scene.json`` does not name. A composition cannot be corrected like the reconstruction that it
came from, so ``reconstruct.json``, stages and report are not copied."""


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class MovedObject:
    """A deformed object.

    vertices: (V, 3) world metres, in the order of its mesh file; faces: (T, 3); splats: in the coordinates of its mesh
    file, or None.
    """

    vertices: Array
    faces: NDArray[np.int64]
    splats: Splats | None = None


@contextmanager
def composition_folder(scene: Scene, out: Path) -> Iterator[Path]:
    """Yield a temporary folder that becomes ``out`` on success and is deleted otherwise.

    Raises InputError where ``out`` is the folder of ``scene``, inside it or a parent of it, or holds anything but an
    earlier composition, so that a scene with edits is never replaced, and where ``scene`` is changed meanwhile.
    """
    ours, theirs = out.resolve(), scene.root.resolve()
    if ours == theirs or theirs in ours.parents or ours in theirs.parents:
        raise InputError(f"{out}: is the scene, inside it or a parent of it; choose another folder for the composition")
    holds = out.is_dir() and any(out.iterdir())
    if holds and not (out / COMPOSE_FILE).is_file():
        raise InputError(f"{out}: holds something other than a composition; choose an empty or new folder")
    with replacing_folder(out) as partial, unchanged_scene(scene):
        yield partial


def write_composition(
    source: Scene, target: Path, moved: Mapping[str, MovedObject], record: Mapping[str, Any]
) -> Scene:
    """Write the scene of ``source`` with the ``moved`` objects, by name, into the new folder ``target``, and ``record``
    as ``compose.json``. Returns the new scene folder. Raises InputError when something cannot be written.
    """
    objects = []
    taken = {item.mesh.casefold() for item in source.model.objects}
    for item in source.model.objects:
        if item.name in moved:
            item = _write_moved(source, target, item, moved[item.name], taken)
        objects.append(item)
    scene = dataclasses.replace(source.model, objects=tuple(objects))
    unmoved = tuple(item for item in scene.objects if item.name not in moved)
    beside = source.with_model(dataclasses.replace(scene, objects=unmoved)).files()
    names = {*referenced_files(scene), *beside, *_unnamed_files(source.root)}
    for name in sorted(names):
        place = inside(target, name)
        if not place.exists():
            _link_or_copy(source.file(name), place)
    write_json(target / COMPOSE_FILE, record)
    return save_scene(target, scene)


def _write_moved(source: Scene, target: Path, item: SceneObject, moved: MovedObject, taken: set[str]) -> SceneObject:
    """Return ``item`` with its own mesh and splat files; objects that shared a mesh have deformed differently."""
    path = source.file(item.mesh)
    name = f"{item.mesh.rpartition('.')[0]}{moved_suffix(path)}"
    users = sum(other.mesh == item.mesh for other in source.model.objects)
    if users > 1 or (name != item.mesh and name.casefold() in taken):
        name = f"meshes/{item.name} fitted{moved_suffix(path)}"
    matrix = np.linalg.inv(np.asarray(item.world_from_mesh, dtype=np.float64))
    write_moved_mesh(path, inside(target, name), transformed(moved.vertices, matrix), moved.faces)
    albedo = f"albedo/{Path(item.mesh).stem}.png"
    if Path(name).stem != Path(item.mesh).stem and (source.root / albedo).is_file():
        _link_or_copy(source.file(albedo), inside(target, f"albedo/{Path(name).stem}.png"))
    changes: dict[str, Any] = {"mesh": name, "size_m": float(np.ptp(moved.vertices, axis=0).max())}
    if moved.splats is not None:
        changes["splats"] = f"splats/{item.name}.ply"
        place = inside(target, changes["splats"])
        place.parent.mkdir(parents=True, exist_ok=True)
        write_splats(place, moved.splats)
    return dataclasses.replace(item, **changes)


def _unnamed_files(root: Path) -> Iterator[str]:
    """Yield the relative paths of ``UNNAMED_FILES`` that exist in ``root``."""
    for entry in UNNAMED_FILES:
        path = root / entry
        files = sorted(path.iterdir()) if path.is_dir() else [path]
        yield from (file.relative_to(root).as_posix() for file in files if file.is_file())


def _link_or_copy(source: Path, target: Path) -> None:
    """Hard-link ``source`` to ``target`` where the file system supports it, else copy it. Raises InputError."""
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        try:
            os.link(source, target)
        except OSError:
            shutil.copyfile(source, target)
    except OSError as error:
        raise InputError(f"{target}: cannot be written ({error.strerror or error}); free space") from error


FORMAT = "physgen-compose/1"


@dataclass(frozen=True, kw_only=True, eq=False)
class GroupResult:
    """A composed group. likeness: before and after, None without a photo; pairs: as in ``compose.json``."""

    group: ContactGroup
    composed: Composition
    likeness: tuple[ImageSimilarity, ImageSimilarity] | None
    pairs: tuple[dict[str, Any], ...]
    notes: tuple[str, ...]


def composition_record(scene: SceneModel, request: ComposeRequest, fits: Sequence[GroupResult]) -> dict[str, Any]:
    """Return the content of ``compose.json`` (docs/file-formats.md)."""
    return {
        "format": FORMAT,
        "method": request.options.method,
        "seed": request.options.seed,
        "options": {
            **dataclasses.asdict(request.options),
            "splats": request.splats,
            "guidance": request.guidance,
            "prompt": request.prompt,
        },
        "picture": scene.photo if request.picture else None,
        "groups": [
            {
                "objects": [body.name for body in fit.group.bodies],
                "likeness": None if fit.likeness is None else [_similarity_json(item) for item in fit.likeness],
                "moved": _displacements(fit),
            }
            for fit in fits
        ],
        "pairs": [pair for fit in fits for pair in fit.pairs],
        "notes": [note for fit in fits for note in fit.notes],
        "versions": _versions(),
    }


def _similarity_json(found: ImageSimilarity) -> dict[str, float | None]:
    return {"psnr_db": found.psnr if math.isfinite(found.psnr) else None, "ssim": found.ssim}


def _displacements(fit: GroupResult) -> dict[str, dict[str, float]]:
    """Return mean and largest vertex displacement in metres, by the names of deformable objects."""
    result = {}
    for body, part in zip(fit.group.bodies[1:], fit.composed.parts[1:], strict=True):
        way = np.linalg.norm(part.surface.vertices - body.surface.vertices, axis=1)
        result[body.name] = {"mean_m": float(way.mean()), "farthest_m": float(way.max())}
    return result


def _versions() -> Mapping[str, str]:
    return {
        "physgen": VERSION,
        "python": platform.python_version(),
        "numpy": np.__version__,
        "taichi": version("taichi"),
    }


def penetration_json(found: Penetration) -> dict[str, float]:
    """Return one state of a pair as in ``compose.json``."""
    return {"volume_m3": found.volume, "share": found.share, "deepest_m": found.deepest}


STAGE = "composing"
GREY = 0.5
"""sRGB of a surface without texture and photo."""

MIN_SPLATS_PER_OBJECT = 50
"""Least number of splats of an object, however small it is."""


def compose(
    scene: Scene,
    *,
    out: str | Path,
    request: ComposeRequest | None = None,
    on_event: OnEvent = ignore,
    cancelled: IsCancelled = never,
) -> Scene:
    """Return ``scene`` with its objects deformed and moved until they no longer penetrate, as the folder ``out``.

    Deformed objects keep vertex order, faces and texture; everything else is unchanged. ``compose.json`` in ``out``
    records what was done and the penetration depths (m) before and after. ``out`` appears whole or not at all, and
    replaces only an earlier composition.

    >>> import physgen
    >>> scene = physgen.load_scene("ring_and_finger")  # doctest: +SKIP
    >>> fitted = physgen.compose(scene, out="fitted")  # doctest: +SKIP

    Raises InputError for an unusable scene, object, image or guidance (docs/composition.md lists the cases);
    SimulationError when the simulation or the guidance fails; Cancelled.
    """
    request = request or ComposeRequest()
    guidance = load_guidance(request.guidance, request.prompt, size=request.options.size)
    out = Path(out)
    with composition_folder(scene, out) as partial:
        if request.picture:
            require_photo(scene)
        found = contact_groups(scene, request.objects, cells=request.options.cells)
        for group in found:
            _require_memory(scene, group, request)
        fits = [_compose_group(scene, group, request, guidance, on_event, cancelled) for group in found]
        moved: dict[str, MovedObject] = {}
        for fit in fits:
            moved |= _moved_objects(fit)
        if cancelled():
            raise Cancelled("the composition was cancelled; nothing was written")
        composed = write_composition(scene, partial, moved, composition_record(scene.model, request, fits))
    return Scene(root=out, model=composed.model)


def _require_memory(scene: Scene, group: ContactGroup, request: ComposeRequest) -> None:
    vertices = max(len(body.surface.vertices) for body in group.bodies)
    splats = request.splats + sum(
        len(read_splats(scene.file(body.item.splats))) for body in group.bodies if body.item.splats is not None
    )
    pixels = request.options.size**2 if request.options.uses_images else 0
    require_memory(
        composition_bytes(request.options.cells, splats, vertices, pixels),
        available_memory(COMPOSITION_RESERVED),
        what=f"{request.options.cells} cells, {splats} splats and meshes of up to {vertices} vertices",
        remedy="give fewer --cells or --splats",
    )


def _compose_group(
    source: Scene,
    group: ContactGroup,
    request: ComposeRequest,
    guidance: NamedGuidance | None,
    on_event: OnEvent,
    cancelled: IsCancelled,
) -> GroupResult:
    options, ground = request.options, source.model.ground
    notes = list(group.notes)
    reference = _reference(source, group, request, notes)
    own = _object_splats(source, group, request, reference)
    parts = tuple(
        CompositionPart(name=body.name, splats=splats, surface=body.surface)
        for body, splats in zip(group.bodies, own, strict=True)
    )
    before = _penetrations(parts)
    deformable = [part.surface for part in parts[1:]]
    held = [surface for surface in deformable if ground_supports(ground, surface)]
    first = parts[0]
    if held:
        assert ground is not None
        first = dataclasses.replace(first, surface=with_ground_slab(first.surface, ground, held))
    for note in notes:
        on_event({"event": "notice", "stage": STAGE, "message": note})
    composed = composition.compose(
        (first, *parts[1:]),
        reference=reference,
        guidance={} if guidance is None else guidance.by_object([part.name for part in parts[1:]]),
        cameras=() if guidance is None else guidance.cameras,
        options=options,
        ground=ground if held else None,
        on_event=on_event,
        cancelled=cancelled,
    )
    # The slab was for the optimiser only.
    composed = dataclasses.replace(composed, parts=(parts[0], *map(_with_closed_seams, parts[1:], composed.parts[1:])))
    after = _penetrations(composed.parts)
    late = [*composed.notes, *_sunk_deeper(ground, parts[1:], composed.parts[1:])]
    for note in late:
        on_event({"event": "notice", "stage": STAGE, "message": note})
    alike = None
    if reference is not None:
        alike = (
            image_similarity(joined([part.splats for part in parts]), reference),
            image_similarity(joined([part.splats for part in composed.parts]), reference),
        )
    return GroupResult(
        group=group,
        composed=composed,
        likeness=alike,
        pairs=tuple(
            {"objects": list(names), "before": penetration_json(before[names]), "after": penetration_json(after[names])}
            for names in before
        ),
        notes=(*notes, *late),
    )


def _sunk_deeper(
    ground: Ground | None, before: Sequence[CompositionPart], after: Sequence[CompositionPart]
) -> Iterator[str]:
    """Yield a note for each part that reaches clearly further into the ground ``after`` than ``before``."""
    for old, new in zip(before, after, strict=True):
        deeper = depth_below_ground(ground, new.surface) - depth_below_ground(ground, old.surface)
        if deeper > 1e-3 * float(np.ptp(new.surface.vertices, axis=0).max()):
            yield f"object {new.name!r}: reaches {length(deeper)} further into the ground than before"


def _with_closed_seams(before: CompositionPart, after: CompositionPart) -> CompositionPart:
    """Return ``after`` with vertices that coincided before coinciding exactly: else its seams would open."""
    _, first, place = np.unique(before.surface.vertices, axis=0, return_index=True, return_inverse=True)
    vertices = after.surface.vertices[first][place.reshape(-1)]
    return dataclasses.replace(after, surface=Surface(vertices=vertices, faces=before.surface.faces))


def _reference(source: Scene, group: ContactGroup, request: ComposeRequest, notes: list[str]) -> Reference | None:
    if not request.picture:
        return None
    items = [body.item for body in group.bodies]
    if any(item.mask is None for item in items):
        notes.append("not all objects have a mask: everything else is taken from the scene's background image")
    return photo_reference(source, items, size=request.options.size)


def _object_splats(
    source: Scene, group: ContactGroup, request: ComposeRequest, reference: Reference | None
) -> list[Splats]:
    """Return the splats of each body in world metres: its own, else sampled from its textured surface."""
    areas = np.array([_area(body.surface) if body.item.splats is None else 0.0 for body in group.bodies])
    found = []
    for body, area in zip(group.bodies, areas, strict=True):
        if body.item.splats is not None:
            matrix = np.asarray(body.item.world_from_mesh, dtype=np.float64)
            found.append(transform_splats(read_splats(source.file(body.item.splats)), matrix))
            continue
        count = max(MIN_SPLATS_PER_OBJECT, round(request.splats * float(area / areas.sum())))
        splats = _sampled_splats(body, count, request.options.seed)
        if reference is not None and body.mesh.picture is None:
            splats = splats.changed(colours=photo_colours(source, splats.centres))
        found.append(splats)
    return found


def _sampled_splats(body: ComposeObject, count: int, seed: int) -> Splats:
    colours = Texture.of(body.mesh) or np.full(body.surface.vertices.shape, GREY)
    return splats_on_mesh(body.surface.vertices, body.surface.faces, colours, count, seed=seed)


def _area(surface: Surface) -> float:
    return float(face_normals(surface.vertices[surface.faces])[1].sum())


def _penetrations(parts: Sequence[CompositionPart]) -> dict[tuple[str, str], Penetration]:
    """Return the penetration by the names of each pair, the fixed one first."""
    found = {}
    for i, a in enumerate(parts):
        for b in parts[i + 1 :]:
            found[a.name, b.name] = penetration_of_meshes(b.surface, a.surface)
    return found


def _moved_objects(fit: GroupResult) -> dict[str, MovedObject]:
    """Return the deformable objects by name; the fixed one keeps its file."""
    result = {}
    for body, part in zip(fit.group.bodies[1:], fit.composed.parts[1:], strict=True):
        splats = None
        if body.item.splats is not None:
            splats = transform_splats(
                part.splats, np.linalg.inv(np.asarray(body.item.world_from_mesh, dtype=np.float64))
            )
        result[body.name] = MovedObject(vertices=part.surface.vertices, faces=part.surface.faces, splats=splats)
    return result
