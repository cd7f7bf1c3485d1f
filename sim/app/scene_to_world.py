# SPDX-License-Identifier: MIT
"""From a scene and its meshes to the engine's world: bodies, colliders, contacts, tracks, effects. No Taichi.

Everything that can be wrong with a scene is found here, before the engine starts, and named by object and field.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

from ..constitutive import SHAPED, cohesion_of
from ..effects.registry import apply_effects
from ..errors import InputError
from ..memory import ENGINE_RESERVED, available_memory
from ..mpm.cost_estimate import Estimate, estimate, longest_step, refuse_excess, stable_step
from ..mpm.implicit_choice import may_pay, why_explicit
from ..mpm.scene_contacts import contact_table
from ..mpm.solver_options import SolverOptions
from ..mpm.world_setup import WorldSetup
from ..scene.bake_quality import Quality, load_quality
from ..scene.folder import Scene
from ..scene.meshes import ObjectMesh
from ..scene.model import SceneObject
from ..scene.units import Similarity
from ..weak_cache import WeakCache
from .bake_options import BakeOptions
from .scene_bodies import body_of, colliders_of, granular_names, jump_notices, surface_of, track_of
from .scene_to_world_checks import require_above_ground, resolve, separate, surface_warnings

_WARNINGS: WeakCache[ObjectMesh, list[str]] = WeakCache()


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
        """Return the number of particles of all bodies that deform."""
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
    setup, notices = _world_setup(folder, meshes, options.seed, spacing=spacing, cell=cell)
    warnings += notices
    solver = dataclasses.replace(solver, max_step=longest_step(setup.bodies, solver))
    step = stable_step(setup.bodies, cell, solver)
    explicit_because = why_explicit(setup)
    stiff = options.implicit and may_pay(setup, step, cell)
    solver = dataclasses.replace(solver, implicit=stiff and explicit_because is None)
    duration = (options.frames - 1) / options.rate
    files = max(_file_bytes(folder, item) for item in scene.objects)
    body_index, collider_index = ({number: index for index, number in enumerate(found)} for found in (moving, still))
    return PreparedWorld(
        setup=setup,
        solver=solver,
        similarity=similarity,
        body_of_object=tuple(body_index.get(i) for i in range(len(scene.objects))),
        collider_of_object=tuple(collider_index.get(i) for i in range(len(scene.objects))),
        warnings=tuple(warnings),
        cost=_cost(setup, _soft_count(setup), step, duration, options.arch, files),
        stable_step=step,
        duration=duration,
        arch=options.arch,
        file_bytes=files,
        explicit_because=explicit_because if stiff else None,
    )


def _world_setup(
    folder: Scene, meshes: Sequence[ObjectMesh], seed: int, *, spacing: float, cell: float
) -> tuple[WorldSetup, list[str]]:
    """Return the description of the scene's world, its effects applied, and notices about it.

    seed: other than 0 moves particles off their lattice. spacing: of particles, m. cell: of the grid, m.
    """
    scene = folder.model
    pairs = list(zip(scene.objects, meshes, strict=True))
    granular = granular_names(scene)
    bodies = tuple(
        body_of(folder, item, mesh, spacing, cell, seed, scattered=item.name in granular)
        for item, mesh in pairs
        if item.role == "dynamic"
    )
    colliders = colliders_of(folder, [(item, mesh) for item, mesh in pairs if item.role == "collider"])
    notices = [text for collider in colliders for text in jump_notices(collider)]
    apart = separate(bodies, colliders, spacing=spacing, cell=cell)
    setup = WorldSetup(
        bodies=apart.bodies,
        ground=scene.ground,
        gravity=scene.gravity,
        gravity_track=track_of(scene.gravity_track),
        colliders=apart.colliders,
        contacts=contact_table(scene),
    )
    return apply_effects(setup, scene.effects), [*notices, *apart.notices]


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


def _surface_warnings(mesh: ObjectMesh, name: str, cell: float, deforms: bool) -> list[str]:
    key = (name, cell, deforms)
    return _WARNINGS.get(mesh, key, lambda: surface_warnings(surface_of(mesh), name, cell, deforms=deforms))


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
