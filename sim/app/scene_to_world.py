# SPDX-License-Identifier: MIT
"""From a scene and its meshes to the engine's world: bodies, colliders, contacts, tracks, effects. No Taichi.

Everything that can be wrong with a scene is found here, before the engine starts, and named by object and field.

Materials become the engine's. Of the particles that fill a mesh, a hollow body has those near its surface. How the
surfaces of a scene meet, pair by pair, follows from the numbers of each surface and of named pairs. Where a pair is not
named, friction is the geometric mean of the two coefficients, so that anything slides on ice, and restitution the
larger of the two, so that a ball that bounces well does so on anything: the rules of Box2D (b2MixFriction and
b2MixRestitution, E. Catto, box2d.org). No law of physics gives a pair's numbers from two surfaces.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from ..constitutive import COHERENT, GRANULAR, SHAPED, DeformableMaterial, RigidMaterial, cohesion_of, model_of
from ..effects.registry import apply_effects
from ..errors import InputError
from ..memory import ENGINE_RESERVED, available_memory
from ..mpm.bodies import BodyParticles
from ..mpm.colliders import Collider, Surface, Track
from ..mpm.cost_estimate import Estimate, estimate, longest_step, refuse_excess, stable_step
from ..mpm.geometry.interior_sampling import MIN_PARTICLES, InteriorSample, sample_interior
from ..mpm.implicit_choice import may_pay, why_explicit
from ..mpm.solver_options import SolverOptions
from ..mpm.surface_contact import GROUND_NAME, ContactTable, SurfaceContact, friction_from_roughness
from ..mpm.world_setup import WorldSetup
from ..scene.bake_quality import Quality, load_quality
from ..scene.folder import Scene
from ..scene.meshes import MAX_TRACK_BYTES, ObjectMesh, load_vertex_track
from ..scene.model import Contact, Ground, Keys, Material, Motion, SceneModel, SceneObject
from ..scene.units import Similarity
from ..weak_cache import WeakCache
from .bake_options import BakeOptions
from .matter_maps import factors_of, nearest_on_surface
from .scene_to_world_checks import require_above_ground, resolve, separate, surface_warnings, thickness_in, vertices_at


def engine_material(material: Material) -> DeformableMaterial | RigidMaterial:
    """Return the constitutive model of the material's law, with the parameters that it reads."""
    if material.law == "rigid":
        return RigidMaterial(density=material.density)
    model = model_of(material.law)
    return model(density=material.density, **{name: getattr(material, name) for name in model.reads})


SHELL_CELLS = 2.0
"""Thickness in grid cells of a shell whose object does not say one: the thinnest that bends about as it should."""


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


HOLDS = ("separate", "slip", "sticky")
"""Modes by how much they hold; of two surfaces the stronger one counts."""


def contact_table(scene: SceneModel) -> ContactTable:
    """Return the contacts of ``scene``; surfaces without numbers of their own count as made of what the ground is.

    Where there is no ground, as made of what a new scene's ground is. Where neither ground nor object says how it
    bounces, a rigid object has its material's restitution against the ground, colliders and, the smaller of the two,
    other rigid objects.
    """
    usual = scene.ground or Ground()
    ground = SurfaceContact(
        friction=usual.friction, static_friction=usual.static_friction, restitution=usual.restitution
    )
    surfaces = {item.name: surface(item, ground) for item in scene.objects}
    if scene.ground is not None:
        surfaces = {GROUND_NAME: ground, **surfaces}
    named = {frozenset(contact.between): contact for contact in scene.contacts}
    bounces = {GROUND_NAME: math.inf} | {item.name: _bounce(item, ground) for item in scene.objects}
    pairs: dict[tuple[str, str], SurfaceContact] = {}
    for a, b in itertools.combinations(surfaces, 2):
        contact = named.get(frozenset((a, b)))
        mixed = mix(surfaces[a], surfaces[b])
        if 0.0 < min(bounces[a], bounces[b]) < math.inf:
            mixed = dataclasses.replace(mixed, restitution=max(mixed.restitution, min(bounces[a], bounces[b])))
        if contact is not None:
            pairs[min(a, b), max(a, b)] = _named(contact, mixed)
        elif mixed != ground:
            pairs[min(a, b), max(a, b)] = mixed
    return ContactTable(default=ground, pairs=MappingProxyType(pairs))


def _bounce(item: SceneObject, ground: SurfaceContact) -> float:
    """Restitution of the object's material where nothing else says one: 0 is none, infinite that the other's counts."""
    if item.role == "collider":
        return math.inf
    given = item.restitution is not None or ground.restitution > 0
    return 0.0 if given or item.material.law != "rigid" else item.material.rigid_restitution


def surface(item: SceneObject, ground: SurfaceContact) -> SurfaceContact:
    """Return the surface of ``item``: its own numbers, its roughness, or what the ground has."""
    friction, static = item.friction, item.static_friction
    if friction is None and item.roughness is not None:
        friction = friction_from_roughness(item.roughness)
    if friction is None:
        friction, static = ground.friction, ground.static_friction
    return SurfaceContact(
        friction=friction,
        static_friction=static,
        restitution=ground.restitution if item.restitution is None else item.restitution,
        mode=item.contact_mode or ground.mode,
    )


def mix(a: SurfaceContact, b: SurfaceContact) -> SurfaceContact:
    """Return the contact of two surfaces that were each judged alone."""
    static = None
    friction = math.sqrt(a.friction * b.friction)
    if a.static_friction is not None or b.static_friction is not None:
        static = max(friction, math.sqrt(a.sticking * b.sticking))
    return SurfaceContact(
        friction=friction,
        static_friction=static,
        restitution=max(a.restitution, b.restitution),
        mode=max(a.mode, b.mode, key=HOLDS.index),
    )


def _named(contact: Contact, mixed: SurfaceContact) -> SurfaceContact:
    friction, static = contact.friction, contact.static_friction
    if friction is None:
        friction, static = mixed.friction, mixed.static_friction
    return SurfaceContact(
        friction=friction,
        static_friction=static,
        restitution=mixed.restitution if contact.restitution is None else contact.restitution,
        mode=contact.mode or mixed.mode,
        rolling_resistance=contact.rolling_resistance,
        adhesion=contact.adhesion,
        adhesion_reach=contact.adhesion_reach,
    )


_SURFACES: WeakCache[ObjectMesh, Surface] = WeakCache()
_SAMPLES: WeakCache[ObjectMesh, InteriorSample] = WeakCache()
_WARNINGS: WeakCache[ObjectMesh, list[str]] = WeakCache()
_THICKNESS: WeakCache[ObjectMesh, float | None] = WeakCache()

JUMP = 1e-3
"""Share of its size by which a collider's motion may begin off the place of its mesh."""

SANDY = "sandy"
"""Effect that turns an object to sand."""

JITTER = 0.2
"""Share of the particle spacing by which a seed other than 0 moves each particle off the lattice along each axis."""


@dataclass(frozen=True, kw_only=True, eq=False)
class PreparedWorld:
    """Input of the engine, with notices for the user.

    body_of_object, collider_of_object: for each object of the scene its place in ``setup``, or None.
    cost: of the whole bake, estimated for ``arch`` from ``stable_step``, ``duration``, s, and ``file_bytes``, of the
        largest mesh file.
    explicit_because: why there are no implicit steps although they might pay, or None.
    """

    setup: WorldSetup
    solver: SolverOptions
    similarity: Similarity
    body_of_object: tuple[int | None, ...]
    collider_of_object: tuple[int | None, ...]
    warnings: tuple[str, ...]
    cost: Estimate
    stable_step: float
    duration: float
    arch: str
    file_bytes: int = 0
    explicit_because: str | None = None

    @property
    def particle_count(self) -> int:
        """Particles of all bodies that deform."""
        return _soft_count(self.setup)

    def require_affordable(self) -> None:
        """Raise InputError when the bake would take too long or more memory than there is."""
        on_host = self.arch in ("cpu", "metal")
        refuse_excess(self.cost, self.particle_count, available_memory(ENGINE_RESERVED) if on_host else None)

    def on(self, arch: str) -> PreparedWorld:
        """Return the same, with the cost on another architecture."""
        cost = _cost(self.setup, self.particle_count, self.stable_step, self.duration, arch, self.file_bytes)
        return dataclasses.replace(self, arch=arch, cost=cost)


def prepare_world(
    folder: Scene,
    meshes: Sequence[ObjectMesh],
    options: BakeOptions,
    quality: Quality | None = None,
    *,
    check_surfaces: bool = True,
) -> PreparedWorld:
    """Return the world of the scene in ``folder``, whose objects have ``meshes``.

    quality: in place of the preset that ``options`` name. What depends on a mesh alone is worked out once for each of
    ``meshes``, as long as the caller keeps it. check_surfaces: warn of meshes that are simulated, but not as they are
    meant; finding them takes longer than all the rest.

    Bodies that share space at the start are simulated without what they share; the warnings say so. Raises InputError
    for a scene in which nothing moves, for meshes that cannot be filled or hit, for bodies that stand in the ground,
    and for what no machine could compute.
    """
    scene = folder.model
    moving = [i for i, item in enumerate(scene.objects) if item.role == "dynamic"]
    still = [i for i, item in enumerate(scene.objects) if item.role == "collider"]
    if not moving:
        raise InputError("objects: none has the role 'dynamic', so nothing would move")
    warnings: list[str] = []
    quality = quality or load_quality(options.quality)
    solver, similarity = resolve(
        [scene.objects[i].name for i in moving], [meshes[i] for i in moving], quality, options.arch
    )
    cell, spacing = solver.cell_size(similarity), solver.particle_spacing(similarity)
    for item, mesh in zip(scene.objects, meshes, strict=True):
        deforms = item.role == "dynamic" and cohesion_of(item.material.law) == SHAPED
        if check_surfaces:
            warnings += _surface_warnings(mesh, item.name, cell, deforms)
    if scene.ground is not None:
        for i in moving:
            require_above_ground(scene.objects[i].name, meshes[i].vertices, scene.ground, cell)
    granular = _granular(scene)
    bodies = tuple(
        _body(folder, item, meshes[i], spacing, cell, options.seed, scattered=item.name in granular)
        for i, item in ((i, scene.objects[i]) for i in moving)
    )
    colliders = _colliders(folder, [(scene.objects[i], meshes[i]) for i in still])
    warnings += [text for collider in colliders for text in _jump(collider)]
    apart = separate(bodies, colliders, spacing=spacing, cell=cell)
    warnings += apart.notices
    setup = WorldSetup(
        bodies=apart.bodies,
        ground=scene.ground,
        gravity=scene.gravity,
        gravity_track=_track(scene.gravity_track),
        colliders=apart.colliders,
        contacts=contact_table(scene),
    )
    setup = apply_effects(setup, scene.effects)
    solver = dataclasses.replace(solver, max_step=longest_step(setup.bodies, solver))
    step = stable_step(setup.bodies, cell, solver)
    explicit_because = why_explicit(setup)
    stiff = options.implicit and may_pay(setup, step, cell)
    solver = dataclasses.replace(solver, implicit=stiff and explicit_because is None)
    duration = (options.frames - 1) / options.rate
    count = _soft_count(setup)
    files = max(_file_bytes(folder, item) for item in scene.objects)
    body_index = {scene_index: index for index, scene_index in enumerate(moving)}
    collider_index = {scene_index: index for index, scene_index in enumerate(still)}
    return PreparedWorld(
        setup=setup,
        solver=solver,
        similarity=similarity,
        body_of_object=tuple(body_index.get(i) for i in range(len(scene.objects))),
        collider_of_object=tuple(collider_index.get(i) for i in range(len(scene.objects))),
        warnings=tuple(warnings),
        cost=_cost(setup, count, step, duration, options.arch, files),
        stable_step=step,
        duration=duration,
        arch=options.arch,
        file_bytes=files,
        explicit_because=explicit_because if stiff else None,
    )


def _file_bytes(folder: Scene, item: SceneObject) -> int:
    try:
        return folder.file(item.mesh).stat().st_size
    except OSError:  # The meshes were given, and their files are gone.
        return 0


def _soft_count(setup: WorldSetup) -> int:
    """Particles that the engine moves; those of rigid bodies only tell their mass and carry their mesh."""
    return sum(body.count for body in setup.bodies if not body.rigid)


def _cost(setup: WorldSetup, particles: int, step: float, duration: float, arch: str, file_bytes: int) -> Estimate:
    """The cost of ``setup``, with the particles of its largest body; a rigid one's mesh is filled, too."""
    largest = max((body.count for body in setup.bodies), default=0)
    return estimate(particles, len(setup.bodies), step, duration, arch, file_bytes=file_bytes, largest=largest)


def _granular(scene: SceneModel) -> set[str]:
    """Names of the objects of sand or snow, or that turn to sand: on a lattice they would fall apart in rows."""
    sandy: set[str] = set()
    for effect in scene.effects:
        if effect.name == SANDY:
            sandy |= set(effect.objects or [item.name for item in scene.objects])
    loose = {item.name for item in scene.objects if cohesion_of(item.material.law) in (COHERENT, GRANULAR)}
    return sandy | loose


def _body(
    folder: Scene, item: SceneObject, mesh: ObjectMesh, spacing: float, cell: float, seed: int, *, scattered: bool
) -> BodyParticles:
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
        surface=_surface(mesh),
        velocity=item.velocity,
        spin=item.spin,
        start_time=item.start_time,
        asleep=item.asleep,
        held=item.held,
        acceleration=_track(item.acceleration),
        velocity_keys=_track(item.velocity_keys),
        pins=_pins(item, sample),
        pin_motion=_track(item.pin_motion),
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


MOST_TRACKS_BYTES = 2 * MAX_TRACK_BYTES
"""Of the vertex tracks of all colliders: a packed file is a thousandth of what it unpacks to."""


def _colliders(folder: Scene, still: Sequence[tuple[SceneObject, ObjectMesh]]) -> tuple[Collider, ...]:
    """Raises InputError for vertex tracks of more than ``MOST_TRACKS_BYTES``."""
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
        surface=_surface(mesh),
        translations=_track(motion.translations),
        rotations=_track(motion.rotations),
        pivot=motion.pivot,
        vertices=vertices,
    )


def _jump(collider: Collider) -> list[str]:
    """Frame 1 shows every mesh where it stands; a motion that begins elsewhere jumps after it."""
    rest = collider.surface.vertices
    off = float(np.abs(vertices_at(collider, 0.0) - rest).max())
    if off <= JUMP * float(np.ptp(rest, axis=0).max()):
        return []
    return [f"{collider.name}: its motion begins {off:.2g} m from where its mesh stands, so it jumps after frame 1"]


def _surface(mesh: ObjectMesh) -> Surface:
    return _SURFACES.get(mesh, None, lambda: Surface(vertices=mesh.vertices, faces=mesh.faces))


def _surface_warnings(mesh: ObjectMesh, name: str, cell: float, deforms: bool) -> list[str]:
    key = (name, cell, deforms)
    return _WARNINGS.get(mesh, key, lambda: surface_warnings(_surface(mesh), name, cell, deforms=deforms))


def _thickness(item: SceneObject, mesh: ObjectMesh, cell: float) -> float | None:
    """Of matter that is thin all over and deforms, None of other. A shell is as thin as it is made."""
    if cohesion_of(item.material.law) != SHAPED:
        return None
    if not item.fill:
        return SHELL_CELLS * cell if item.shell_thickness is None else item.shell_thickness
    return _THICKNESS.get(mesh, cell, lambda: thickness_in(_surface(mesh), cell))


def _track(keys: Keys) -> Track | None:
    if not keys:
        return None
    return Track(times=np.array([key.time_s for key in keys]), values=np.array([key.value for key in keys]))


def cost_text(prepared: PreparedWorld) -> str:
    """Return the estimated cost of the bake as one line of text."""
    cost = prepared.cost
    return (
        f"about {_duration(cost.seconds)} of computing and {cost.bytes / 2**20:.0f} MiB: {prepared.particle_count} "
        f"particles, {cost.substeps} time steps of {prepared.stable_step * 1e6:.0f} µs, cells of "
        f"{prepared.solver.cell_size(prepared.similarity) * 1000:.3g} mm"
    )


def steps_text(prepared: PreparedWorld) -> str | None:
    """Return what the bake will do about stiff matter as one line of text; None where there is none."""
    if prepared.solver.implicit and prepared.arch == "cpu":
        return "stiff objects take longer, implicit time steps while they fly, slide or rest, so it may be much less"
    if prepared.explicit_because is not None and prepared.arch == "cpu":
        return f"short time steps throughout, since {prepared.explicit_because}"
    return None


def _duration(seconds: float) -> str:
    for limit, size, unit in ((120.0, 1.0, "s"), (7200.0, 60.0, "min"), (172800.0, 3600.0, "h")):
        if seconds < limit:
            return f"{seconds / size:.0f} {unit}"
    return f"{seconds / 86400:.3g} days"
