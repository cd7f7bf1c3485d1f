# SPDX-License-Identifier: MIT
"""Bodies and colliders of the engine, and masses, from the objects of a scene and their meshes. No Taichi.

Materials become the engine's. Of the particles that fill a mesh, a hollow body has those near its surface.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..constitutive import COHERENT, GRANULAR, SHAPED, DeformableMaterial, RigidMaterial, cohesion_of, model_of
from ..errors import InputError
from ..mpm.bodies import BodyParticles
from ..mpm.colliders import Collider, Surface, Track
from ..mpm.geometry.interior_sampling import MIN_PARTICLES, InteriorSample, sample_interior
from ..mpm.geometry.mass_properties import mesh_properties
from ..scene.folder import Scene
from ..scene.meshes import MAX_TRACK_BYTES, ObjectMesh, load_vertex_track
from ..scene.model import Keys, Material, Motion, SceneModel, SceneObject
from ..weak_cache import WeakCache
from .matter_maps import factors_of, nearest_on_surface
from .scene_to_world_checks import thickness_in, vertices_at

SHELL_CELLS = 2.0
"""Thickness in grid cells of a shell whose object does not say one: the thinnest that bends about as it should."""

JUMP = 1e-3
"""Share of its size by which a collider's motion may begin off the place of its mesh."""

SANDY = "sandy"
"""Effect that turns an object to sand."""

JITTER = 0.2
"""Share of the particle spacing by which a seed other than 0 moves each particle off the lattice along each axis."""

MOST_TRACKS_BYTES = 2 * MAX_TRACK_BYTES
"""Of the vertex tracks of all colliders: a packed file is a thousandth of what it unpacks to."""

_SURFACES: WeakCache[ObjectMesh, Surface] = WeakCache()
_SAMPLES: WeakCache[ObjectMesh, InteriorSample] = WeakCache()
_THICKNESS: WeakCache[ObjectMesh, float | None] = WeakCache()


def engine_material(material: Material) -> DeformableMaterial | RigidMaterial:
    """Return the constitutive model of the material's law, with the parameters that it reads."""
    if material.law == "rigid":
        return RigidMaterial(density=material.density)
    model = model_of(material.law)
    return model(density=material.density, **{name: getattr(material, name) for name in model.reads})


def keep_shell(sample: InteriorSample, mesh: ObjectMesh, thickness: float, spacing: float) -> InteriorSample:
    """Return the particles of ``sample`` whose middle is within ``thickness`` m of the surface of ``mesh``.

    The inside is empty: mass and inertia are the shell's, and nothing but the shell resists bending and pressure. The
    volume is right to about half a particle ``spacing`` of thickness. Raises InputError for a shell thinner than the
    spacing, which would have holes.
    """
    if thickness < spacing:
        raise InputError(
            f"shell_thickness is {thickness:g} m: give {spacing:.2g} m (the particle spacing) or more, or bake finer"
        )
    nearest = nearest_on_surface(mesh, sample.positions, spacing)[1]
    distance = np.linalg.norm(nearest - sample.positions, axis=1)
    keep = distance <= thickness
    if int(keep.sum()) < MIN_PARTICLES:
        raise InputError(f"shell_thickness is {thickness:g} m: that leaves {int(keep.sum())} particles; give more")
    return InteriorSample(
        positions=sample.positions[keep], volumes=sample.volumes[keep], contact_radii=sample.contact_radii[keep]
    )


def granular_names(scene: SceneModel) -> set[str]:
    """Return the names of the objects of sand or snow, or that turn to sand: on a lattice they would part in rows."""
    sandy: set[str] = set()
    for effect in scene.effects:
        if effect.name == SANDY:
            sandy |= set(effect.objects or [item.name for item in scene.objects])
    loose = {item.name for item in scene.objects if cohesion_of(item.material.law) in (COHERENT, GRANULAR)}
    return sandy | loose


def body_of(
    folder: Scene, item: SceneObject, mesh: ObjectMesh, spacing: float, cell: float, seed: int, *, scattered: bool
) -> BodyParticles:
    """Return the body of ``item``, filled with particles ``spacing`` m apart on a grid of cells of ``cell`` m.

    seed: other than 0 moves the particles off their lattice. scattered: they lie on none. Raises InputError for a mesh
    that cannot be filled, for pins that hold nothing, and for a rigid body with pins or goals.
    """
    if item.material.law == "rigid" and (item.pins or item.goal_stiffness > 0):
        raise InputError(
            f"object {item.name}: has pins or goal_stiffness and the law 'rigid': choose another law or leave them "
            "out; role 'collider' with motion holds or leads a rigid thing"
        )
    try:
        sample = _SAMPLES.get(
            mesh,
            (spacing, seed, scattered),
            lambda: sample_interior(
                mesh.vertices, mesh.faces, spacing, jitter=JITTER if seed else 0.0, seed=seed, scattered=scattered
            ),
        )
        if not item.fill:
            thickness = SHELL_CELLS * cell if item.shell_thickness is None else item.shell_thickness
            sample = keep_shell(sample, mesh, thickness, spacing)
    except InputError as error:
        raise InputError(f"object {item.name}: {error}") from None
    stiffness, density = (
        None if factors is None else factors_of(folder, item, mesh, factors, sample.positions, spacing)
        for factors in (item.stiffness_map, item.density_map)
    )
    return BodyParticles(
        name=item.name,
        positions=sample.positions,
        volumes=sample.volumes,
        contact_radii=sample.contact_radii,
        thickness=_thickness(item, mesh, cell),
        material=engine_material(item.material),
        surface=surface_of(mesh),
        velocity=item.velocity,
        spin=item.spin,
        start_time=item.start_time,
        asleep=item.asleep,
        held=item.held,
        acceleration=track_of(item.acceleration),
        velocity_keys=track_of(item.velocity_keys),
        pins=_pins(item, sample),
        pin_motion=track_of(item.pin_motion),
        goal_stiffness=item.goal_stiffness,
        goal_damping=item.goal_damping,
        parameter_tracks={
            track.field: Track(
                times=np.array([key.time_s for key in track.keys]), values=np.array([key.value for key in track.keys])
            )
            for track in item.material_tracks
        },
        stiffness_scale=stiffness,
        density_scale=density,
    )


def _pins(item: SceneObject, sample: InteriorSample) -> NDArray[np.bool_] | None:
    """Which particles lie in a box of pins; None without boxes. Raises InputError for a box that holds none."""
    if not item.pins:
        return None
    pinned = np.zeros(len(sample.positions), dtype=np.bool_)
    for i, box in enumerate(item.pins):
        inside = ((sample.positions >= box.low) & (sample.positions <= box.high)).all(axis=1)
        if not inside.any():
            low, high = sample.positions.min(axis=0), sample.positions.max(axis=0)
            raise InputError(
                f"object {item.name}: pins[{i}] from {box.low} to {box.high} holds none of its material, which is "
                f"between {low.round(4).tolist()} and {high.round(4).tolist()}: move or enlarge the box"
            )
        pinned |= inside
    return pinned


def colliders_of(folder: Scene, still: Sequence[tuple[SceneObject, ObjectMesh]]) -> tuple[Collider, ...]:
    """Return the colliders of the objects ``still``. Raises InputError for vertex tracks of more than
    ``MOST_TRACKS_BYTES``."""
    found, left = [], MOST_TRACKS_BYTES
    for item, mesh in still:
        found.append(_collider(folder, item, mesh))
        track = found[-1].vertices
        left -= 0 if track is None else track.values.nbytes
        if left < 0:
            raise InputError(
                f"object {item.name}: the vertex tracks up to its own take more than {MOST_TRACKS_BYTES >> 30} GiB; "
                "give fewer keyframes"
            )
    return tuple(found)


def _collider(folder: Scene, item: SceneObject, mesh: ObjectMesh) -> Collider:
    motion = item.motion or Motion()
    vertices = None
    if motion.vertices_file is not None:
        times, values = load_vertex_track(folder.file(motion.vertices_file), len(mesh.vertices))
        vertices = Track(times=times, values=values)
    return Collider(
        name=item.name,
        surface=surface_of(mesh),
        translations=track_of(motion.translations),
        rotations=track_of(motion.rotations),
        pivot=motion.pivot,
        vertices=vertices,
    )


def jump_notices(collider: Collider) -> list[str]:
    """Return a notice where the motion of ``collider`` does not begin where its mesh stands, which frame 1 shows."""
    rest = collider.surface.vertices
    off = float(np.abs(vertices_at(collider, 0.0) - rest).max())
    if off <= JUMP * float(np.ptp(rest, axis=0).max()):
        return []
    return [f"{collider.name}: its motion begins {off:.2g} m from where its mesh stands, so it jumps after frame 1"]


def surface_of(mesh: ObjectMesh) -> Surface:
    """Return the surface of ``mesh``, the same one each time."""
    return _SURFACES.get(mesh, None, lambda: Surface(vertices=mesh.vertices, faces=mesh.faces))


def _thickness(item: SceneObject, mesh: ObjectMesh, cell: float) -> float | None:
    """Of matter that is thin all over and deforms, None of other. A shell is as thin as it is made."""
    if cohesion_of(item.material.law) != SHAPED:
        return None
    if not item.fill:
        return SHELL_CELLS * cell if item.shell_thickness is None else item.shell_thickness
    return _THICKNESS.get(mesh, cell, lambda: thickness_in(surface_of(mesh), cell))


def track_of(keys: Keys) -> Track | None:
    """Return the track through ``keys``; None where there are none."""
    if not keys:
        return None
    return Track(times=np.array([key.time_s for key in keys]), values=np.array([key.value for key in keys]))


@dataclass(frozen=True, kw_only=True, eq=False)
class Mass:
    """mass kg; centre (3,) m, world; inertia (3,) kg m² about ``axes`` (3, 3), columns, right-handed."""

    mass: float
    centre: NDArray[np.float64]
    inertia: NDArray[np.float64]
    axes: NDArray[np.float64]


def mass_of(
    item: SceneObject,
    vertices: NDArray[np.float64],
    faces: NDArray[np.int64],
    *,
    thickness: float | None = None,
) -> Mass:
    """Return the mass of the object with ``vertices`` (V, 3), world m: of the solid that its mesh encloses.

    thickness: of the wall of a hollow one, m, which then counts as a thin shell. Raises InputError where the mesh
    encloses nothing.
    """
    try:
        found = mesh_properties(vertices, faces, density=item.material.density, thickness=thickness)
    except InputError as error:
        raise InputError(f"object {item.name}: {error}") from None
    inertia, axes = np.linalg.eigh(found.inertia)
    axes[:, 2] *= np.sign(np.linalg.det(axes))
    return Mass(mass=found.mass, centre=found.center, inertia=inertia, axes=axes)
