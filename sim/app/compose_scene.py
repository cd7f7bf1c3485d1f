# SPDX-License-Identifier: MIT
"""Scene folder → another in which objects no longer penetrate each other (docs/composition.md)."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..errors import Cancelled
from ..events import IsCancelled, OnEvent, ignore, never
from ..gaussians.compose import composition
from ..gaussians.compose.compose_options import ComposeRequest
from ..gaussians.compose.composition_parts import CompositionPart, Reference
from ..gaussians.compose.penetration import Penetration, penetration_of_meshes
from ..gaussians.mesh_to_splats import Texture, splats_on_mesh
from ..gaussians.splat_ply import read_splats
from ..gaussians.splats import Splats, joined, transform_splats
from ..memory import COMPOSITION_RESERVED, available_memory, composition_bytes, require_memory
from ..mpm.colliders import Surface
from ..mpm.geometry.triangles import face_normals
from ..scene.folder import Scene
from ..scene.model import Ground
from .compose_inputs import (
    ComposeObject,
    ContactGroup,
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
from .composition_folder import (
    GroupResult,
    MovedObject,
    composition_folder,
    composition_record,
    penetration_json,
    write_composition,
)

Array = NDArray[np.float64]

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
