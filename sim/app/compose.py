# SPDX-License-Identifier: MIT
"""Scene folder → another in which objects no longer pass through each other (docs/compositional-assets.md)."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ..errors import Cancelled
from ..events import IsCancelled, OnEvent, ignore, never
from ..gaussians.compose.asset import Piece, Reference
from ..gaussians.compose.compose import compose
from ..gaussians.moving import placed
from ..gaussians.physics.penetration import Penetration, penetration_of_meshes
from ..gaussians.ply.read import read_splats
from ..gaussians.sample import Texture, splats_on_mesh
from ..gaussians.splats import Splats, joined
from ..mpm.colliders import Surface
from ..mpm.triangles import face_normals
from ..scene.folder import SceneFolder, load_scene
from .compose_ground import depth_below, holds, with_ground
from .compose_guidance import Named, guidance_of
from .compose_objects import Body, Group, groups, length
from .compose_output import Moved, composition_folder, write_composition
from .compose_picture import likeness, reference_of, require_picture, seen_colours
from .compose_record import Fit, penetration_json, record_of
from .compose_request import ComposeRequest

STAGE = "composing"
GREY = 0.5
"""sRGB of a surface without a texture, where no photo is looked at."""

LEAST_PER_OBJECT = 50
"""Splats of an object however small it is beside the others."""


def compose_scene(
    root: Path,
    out: Path,
    request: ComposeRequest | None = None,
    on_event: OnEvent = ignore,
    cancelled: IsCancelled = never,
) -> SceneFolder:
    """Make ``out`` the scene of the folder ``root`` with its objects brought to fit each other.

    What moves has the same vertices, faces and texture in other places; all else is as it was. ``compose.json`` beside
    the scene says what was done, and how far objects were in each other before and after. ``out`` appears whole or not
    at all, and replaces an earlier composition only.

    Raises InputError for a scene, objects, pictures or a guidance that cannot be used, as docs/compositional-assets.md
    lists them; SimulationError when the simulation or the guidance fails; Cancelled.
    """
    request = request or ComposeRequest()
    guidance = guidance_of(request.guidance, request.prompt, size=request.options.size)
    with composition_folder(root, out) as partial:
        source = load_scene(root)
        if request.picture:
            require_picture(source)
        found = groups(source, request.objects, cells=request.options.cells)
        fits = [_fit(source, group, request, guidance, on_event, cancelled) for group in found]
        moved: dict[str, Moved] = {}
        for fit in fits:
            moved |= _moved(fit)
        if cancelled():
            raise Cancelled("the composition was cancelled; nothing was written")
        scene = write_composition(source, partial, moved, record_of(source.scene, request, fits))
    return SceneFolder(root=out, scene=scene.scene)


def _fit(
    source: SceneFolder,
    group: Group,
    request: ComposeRequest,
    guidance: Named | None,
    on_event: OnEvent,
    cancelled: IsCancelled,
) -> Fit:
    options, ground = request.options, source.scene.ground
    notes = list(group.notes)
    reference = _reference(source, group, request, notes)
    own = _own_splats(source, group, request, reference)
    pieces = tuple(
        Piece(name=body.name, splats=splats, surface=body.surface)
        for body, splats in zip(group.bodies, own, strict=True)
    )
    before = _penetrations(pieces)
    yielding = [piece.surface for piece in pieces[1:]]
    held = [surface for surface in yielding if holds(ground, surface)]
    first = pieces[0]
    if held:
        assert ground is not None
        first = dataclasses.replace(first, surface=with_ground(first.surface, ground, held))
    for note in notes:
        on_event({"event": "notice", "stage": STAGE, "message": note})
    composed = compose(
        (first, *pieces[1:]),
        reference=reference,
        guidance={} if guidance is None else guidance.by_object([piece.name for piece in pieces[1:]]),
        cameras=() if guidance is None else guidance.cameras,
        options=options,
        on_event=on_event,
        cancelled=cancelled,
    )
    # The slab was the optimiser's only.
    composed = dataclasses.replace(composed, pieces=(pieces[0], *map(_with_seams, pieces[1:], composed.pieces[1:])))
    after = _penetrations(composed.pieces)
    late = list(composed.notes)
    for old, new in zip(pieces[1:], composed.pieces[1:], strict=True):
        deeper = depth_below(ground, new.surface) - depth_below(ground, old.surface)
        if deeper > 1e-3 * float(np.ptp(new.surface.vertices, axis=0).max()):
            late.append(f"object {new.name!r}: reaches {length(deeper)} further into the ground than before")
    for note in late:
        on_event({"event": "notice", "stage": STAGE, "message": note})
    alike = None
    if reference is not None:
        alike = (
            likeness(joined([piece.splats for piece in pieces]), reference),
            likeness(joined([piece.splats for piece in composed.pieces]), reference),
        )
    return Fit(
        group=group,
        composed=composed,
        likeness=alike,
        pairs=tuple(
            {"objects": list(names), "before": penetration_json(before[names]), "after": penetration_json(after[names])}
            for names in before
        ),
        notes=(*notes, *late),
    )


def _with_seams(before: Piece, after: Piece) -> Piece:
    """``after`` with vertices that were in one place in one place, to the last bit: else its seams would be open."""
    _, first, place = np.unique(before.surface.vertices, axis=0, return_index=True, return_inverse=True)
    vertices = after.surface.vertices[first][place.reshape(-1)]
    return dataclasses.replace(after, surface=Surface(vertices=vertices, faces=before.surface.faces))


def _reference(source: SceneFolder, group: Group, request: ComposeRequest, notes: list[str]) -> Reference | None:
    if not request.picture:
        return None
    items = [body.item for body in group.bodies]
    if any(item.mask is None for item in items):
        notes.append("not all objects have a mask: everything but them is taken from the scene's background picture")
    return reference_of(source, items, size=request.options.size)


def _own_splats(
    source: SceneFolder, group: Group, request: ComposeRequest, reference: Reference | None
) -> list[Splats]:
    """Splats of each body in world metres: those that it has, else sampled from its textured surface."""
    areas = np.array([_area(body.surface) if body.item.splats is None else 0.0 for body in group.bodies])
    found = []
    for body, area in zip(group.bodies, areas, strict=True):
        if body.item.splats is not None:
            matrix = np.asarray(body.item.world_from_mesh, dtype=np.float64)
            found.append(placed(read_splats(source.file(body.item.splats)), matrix))
            continue
        count = max(LEAST_PER_OBJECT, round(request.splats * float(area / areas.sum())))
        splats = _sampled(body, count, request.options.seed)
        if reference is not None and body.mesh.picture is None:
            splats = splats.changed(colours=seen_colours(source, splats.centres))
        found.append(splats)
    return found


def _sampled(body: Body, count: int, seed: int) -> Splats:
    colours = Texture.of(body.mesh) or np.full(body.surface.vertices.shape, GREY)
    return splats_on_mesh(body.surface.vertices, body.surface.faces, colours, count, seed=seed)


def _area(surface: Surface) -> float:
    return float(face_normals(surface.vertices[surface.faces])[1].sum())


def _penetrations(pieces: Sequence[Piece]) -> dict[tuple[str, str], Penetration]:
    """By the names of each pair, what stays first."""
    found = {}
    for i, a in enumerate(pieces):
        for b in pieces[i + 1 :]:
            found[a.name, b.name] = penetration_of_meshes(b.surface, a.surface)
    return found


def _moved(fit: Fit) -> dict[str, Moved]:
    """Those that yielded; what stays keeps its file."""
    result = {}
    for body, piece in zip(fit.group.bodies[1:], fit.composed.pieces[1:], strict=True):
        splats = None
        if body.item.splats is not None:
            splats = placed(piece.splats, np.linalg.inv(np.asarray(body.item.world_from_mesh, dtype=np.float64)))
        result[body.name] = Moved(vertices=piece.surface.vertices, faces=piece.surface.faces, splats=splats)
    return result
