# SPDX-License-Identifier: MIT
"""Which objects of a scene are brought to fit, and in which order they yield. No Taichi."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from ..errors import InputError
from ..mpm.colliders import Surface
from ..mpm.soundness import check_surface
from ..mpm.triangles import check_closed, face_normals, validated, winding_numbers
from ..scene.folder import SceneFolder
from ..scene.glb import TexturedMesh, read_textured_mesh, transformed
from ..scene.model import SceneObject

Array = NDArray[np.float64]

GAP_SAMPLES = 20_000
"""Places on each surface between which the gap is looked for."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Body:
    """An object of the scene with its mesh. mesh: as the file has it; surface: in world metres, vertex for vertex."""

    item: SceneObject
    mesh: TexturedMesh
    surface: Surface

    @property
    def name(self) -> str:
        """The object's name."""
        return self.item.name

    @property
    def size(self) -> float:
        """Longest side of its box in metres."""
        return float(np.ptp(self.surface.vertices, axis=0).max())


@dataclass(frozen=True, kw_only=True, eq=False)
class Group:
    """Bodies that hang together, from the one that stays to the ones that yield; notes: what is odd about them."""

    bodies: tuple[Body, ...]
    notes: tuple[str, ...]


def read_body(folder: SceneFolder, item: SceneObject) -> Body:
    """The object ``item`` with its mesh. Raises InputError as ``read_textured_mesh`` does."""
    mesh = read_textured_mesh(folder.file(item.mesh))
    matrix = np.asarray(item.world_from_mesh, dtype=np.float64)
    faces = mesh.faces[:, ::-1] if np.linalg.det(matrix[:3, :3]) < 0 else mesh.faces
    return Body(
        item=item,
        mesh=mesh,
        surface=Surface(vertices=transformed(mesh.vertices, matrix), faces=faces),
    )


def groups(folder: SceneFolder, names: Sequence[str], *, cells: int) -> tuple[Group, ...]:
    """The objects that are to fit each other, in groups that touch.

    names: from the one that stays to those that yield; empty: all that touch another, frontmost first, as what hides
    others is what was seen whole. cells: two bodies touch when they are nearer than one of as many cells along both
    together, which is as far as the simulation sees.

    Raises InputError for names that are not there or given twice, for fewer than two objects, for one that touches no
    other (with the distance), that lies wholly inside another, whose mesh is open, and for a collider that would have
    to yield.
    """
    chosen = _chosen(folder, names)
    bodies = [read_body(folder, item) for item in chosen]
    gaps = _gaps(bodies)
    near = np.array([[_reach(a, b, cells) for b in bodies] for a in bodies])
    touching = gaps <= near
    np.fill_diagonal(touching, False)
    alone = ~touching.any(axis=1)
    if alone.all() or (names and alone.any()):
        raise InputError(_apart(bodies, gaps, int(np.flatnonzero(alone)[0]) if names else None))
    count, label = connected_components(coo_matrix(touching), directed=False)
    if names and count > 1:
        other = int(np.flatnonzero(label != label[0])[0])
        raise InputError(_apart([bodies[0], bodies[other]], gaps[np.ix_([0, other], [0, other])], 1))
    found = []
    for number in range(count):
        members = [bodies[i] for i in np.flatnonzero((label == number) & ~alone)]
        if len(members) > 1:
            found.append(_checked(members))
    return tuple(found)


def _chosen(folder: SceneFolder, names: Sequence[str]) -> list[SceneObject]:
    known = {item.name: item for item in folder.scene.objects}
    for name in names:
        if name not in known:
            raise InputError(f"objects: there is no {name!r} in {folder.root}; choose some of {', '.join(known)}")
    if len(set(names)) < len(names):
        raise InputError(f"objects: {', '.join(names)}: name every object once")
    if len(names) == 1 or len(known) < 2:
        raise InputError(f"objects: {', '.join(names or known)}: give two or more that are to fit each other")
    if names:
        return [known[name] for name in names]
    # What nothing moves stays; of equally near ones the first.
    return sorted(known.values(), key=lambda item: (item.role != "collider", item.occlusion_order))


def _checked(bodies: list[Body]) -> Group:
    notes: list[str] = []
    for body in bodies:
        notes += check_surface(body.surface, name=f"object {body.name!r}")
    late = [body.name for body in bodies[1:] if body.item.role == "collider" and bodies[0].item.role != "collider"]
    if late:
        raise InputError(f"object {late[0]!r}: is a collider and yields to nobody; name it first, or let it move")
    for i, a in enumerate(bodies):
        for b in bodies[i + 1 :]:
            for inner, outer in ((a, b), (b, a)):
                if _is_inside(inner.surface, outer.surface):
                    raise InputError(
                        f"object {inner.name!r}: is wholly inside {outer.name!r}, and nothing says on which side it "
                        "belongs; move it until it shows, or leave it out"
                    )
    return Group(bodies=tuple(bodies), notes=tuple(notes))


def _reach(a: Body, b: Body, cells: int) -> float:
    low = np.minimum(a.surface.vertices.min(axis=0), b.surface.vertices.min(axis=0))
    high = np.maximum(a.surface.vertices.max(axis=0), b.surface.vertices.max(axis=0))
    # Far apart they would seem the nearer the farther they are.
    return min(float((high - low).max()), a.size + b.size) / cells


def _gaps(bodies: Sequence[Body]) -> Array:
    """Metres (N, N) between the surfaces, about; 0 where they pass through each other or one is in the other."""
    clouds = [_places_on(body.surface) for body in bodies]
    trees = [cKDTree(cloud) for cloud in clouds]
    result = np.zeros((len(bodies), len(bodies)))
    for i, a in enumerate(bodies):
        for j in range(i + 1, len(bodies)):
            b = bodies[j]
            away = float(trees[j].query(clouds[i])[0].min())
            if away > 0 and (_holds(a.surface, clouds[j]).any() or _holds(b.surface, clouds[i]).any()):
                away = 0.0
            result[i, j] = result[j, i] = away
    return result


def _places_on(surface: Surface) -> Array:
    """Vertices and evenly strewn places (P, 3) on a surface."""
    corners = surface.vertices[surface.faces]
    area = face_normals(corners)[1]
    random = np.random.default_rng(0)
    weights = area / area.sum() if area.sum() > 0 else None
    which = random.choice(len(corners), size=GAP_SAMPLES, p=weights)
    share = random.dirichlet((1.0, 1.0, 1.0), size=GAP_SAMPLES)
    used = surface.vertices[np.unique(surface.faces)]
    return np.concatenate([used, np.einsum("nk,nkc->nc", share, corners[which])])


def _holds(surface: Surface, places: Array) -> NDArray[np.bool_]:
    """Which places (N,) are inside; of an open surface none can be."""
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
    return bool(_holds(outer, _places_on(inner)).all())


def _apart(bodies: Sequence[Body], gaps: Array, which: int | None) -> str:
    """What to say of objects that touch nothing: ``which`` of them, or the two that are nearest."""
    away = gaps + np.diag(np.full(len(bodies), np.inf))
    i = int(away.min(axis=1).argmin()) if which is None else which
    j = int(away[i].argmin())
    return (
        f"objects {bodies[i].name!r} and {bodies[j].name!r} do not touch: they are {length(float(away[i, j]))} apart; "
        "there is nothing to fit. Move them until they touch, or choose others"
    )


def length(metres: float) -> str:
    """Metres for people, such as ``3.2 cm``."""
    for unit, size in (("m", 1.0), ("cm", 1e-2), ("mm", 1e-3)):
        if metres >= size:
            return f"{metres / size:.3g} {unit}"
    return f"{metres * 1e3:.2g} mm"
