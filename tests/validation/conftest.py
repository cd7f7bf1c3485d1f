# SPDX-License-Identifier: MIT
"""Bodies and grids that the validation of the engine shares.

Tolerances in this folder are requirements (see docs/physics.md), not fits to what the engine does.
"""

from __future__ import annotations

import os
from collections.abc import Callable

import numpy as np
import pytest
import trimesh
from physgen.sim.constitutive import ElasticMaterial, RigidMaterial
from physgen.sim.mpm.bodies import BodyParticles
from physgen.sim.mpm.colliders import Surface
from physgen.sim.mpm.kernels import runtime
from physgen.sim.mpm.rigid.rigid_bodies import RigidBodies
from physgen.sim.mpm.solver_options import SolverOptions
from physgen.sim.mpm.world import World
from physgen.sim.mpm.world_setup import WorldSetup
from physgen.sim.scene.units import Similarity

GRID = 64
CELL = 2.0 / GRID  # metres, with the similarity below
ARCH = os.environ.get("PHYSGEN_TEST_ARCH", "cpu")
"""Where the engine computes; ``benchmarks/gpu.sh`` sets it."""

BoxFactory = Callable[..., BodyParticles]
Block = Callable[..., BodyParticles]
GiveMotion = Callable[[World, np.ndarray, np.ndarray], None]


@pytest.fixture
def options() -> SolverOptions:
    return SolverOptions(grid=GRID, arch=ARCH)


@pytest.fixture
def repeatable() -> None:
    """Skip what wants equal bytes where they are not promised."""
    if ARCH != "cpu":
        pytest.skip("a graphics card adds in any order: bytes are repeatable on the CPU")


@pytest.fixture
def similarity() -> Similarity:
    """A box of 2 m around the world's origin."""
    return Similarity(scale=1.0, origin=(-1.0, -1.0, -1.0))


def lattice_box(
    *,
    cells: tuple[int, int, int] = (6, 6, 6),
    cell: float = CELL,
    bottom: tuple[float, float, float] = (0.0, 0.0, 0.0),
    rotation: np.ndarray | None = None,
    youngs_modulus: float = 1e6,
    density: float = 1000.0,
    poisson_ratio: float = 0.3,
    name: str = "box",
    **motion: object,
) -> BodyParticles:
    """Box of 8 particles a cell, standing with the centre of its underside on ``bottom``, then rotated about it."""
    spacing = cell / 2
    counts = [2 * c for c in cells]
    index = np.stack(np.meshgrid(*[np.arange(n) for n in counts], indexing="ij"), axis=-1).reshape(-1, 3)
    local = (index + 0.5) * spacing - np.array([counts[0], counts[1], 0]) * spacing / 2
    if rotation is not None:
        local = local @ rotation.T
    return BodyParticles(
        name=name,
        positions=local + np.asarray(bottom),
        volumes=np.full(len(local), spacing**3),
        material=ElasticMaterial(density=density, youngs_modulus=youngs_modulus, poisson_ratio=poisson_ratio),
        contact_radii=np.full(len(local), spacing / 2),
        **motion,
    )


@pytest.fixture
def box() -> BoxFactory:
    return lattice_box


@pytest.fixture
def cell() -> float:
    """Side of a grid cell in metres under ``options`` and ``similarity``."""
    return CELL


def rigid_box(
    *,
    center: tuple[float, float, float] = (0.0, 0.0, 0.0),
    size: tuple[float, float, float] = (0.2, 0.2, 0.2),
    rotation: np.ndarray | None = None,
    density: float = 1000.0,
    name: str = "box",
    **fields: object,
) -> BodyParticles:
    """Rigid box about ``center``; its particles are cubes that fill it, which gives it the exact inertia of a cube."""
    n = 8
    index = np.stack(np.meshgrid(*[np.arange(n)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    turn = np.eye(3) if rotation is None else rotation
    mesh = trimesh.creation.box(size)
    return BodyParticles(
        name=name,
        positions=(((index + 0.5) / n - 0.5) * np.asarray(size)) @ turn.T + np.asarray(center),
        volumes=np.full(n**3, np.prod(size) / n**3),
        material=RigidMaterial(density=density),
        surface=Surface(vertices=np.asarray(mesh.vertices) @ turn.T + np.asarray(center), faces=np.asarray(mesh.faces)),
        **fields,
    )


def rigid_ball(
    *,
    center: tuple[float, float, float] = (0.0, 0.0, 0.0),
    radius: float = 0.1,
    density: float = 1000.0,
    subdivisions: int = 4,
    name: str = "ball",
    **fields: object,
) -> BodyParticles:
    """Rigid ball of six particles, placed such that its moment of inertia is 2/5 m r² exactly."""
    volume = 4 / 3 * np.pi * radius**3 / 6
    arm = np.sqrt(1.5 * (0.4 * radius**2 - volume ** (2 / 3) / 6))
    mesh = trimesh.creation.icosphere(subdivisions=subdivisions, radius=radius)
    return BodyParticles(
        name=name,
        positions=np.concatenate([np.eye(3), -np.eye(3)]) * arm + np.asarray(center),
        volumes=np.full(6, volume),
        material=RigidMaterial(density=density),
        surface=Surface(vertices=np.asarray(mesh.vertices) + np.asarray(center), faces=np.asarray(mesh.faces)),
        **fields,
    )


def lattice_block(material, size, *, cell=CELL, bottom=(0.0, 0.0, 0.0), name="block", **fields) -> BodyParticles:
    """Box of ``size`` (3) cells of any material, 8 particles a cell, its underside's centre on ``bottom``.

    A function among ``fields`` is called with the particles' places, for values that particles have of their own.
    """
    spacing = cell / 2
    counts = [2 * c for c in size]
    index = np.stack(np.meshgrid(*[np.arange(n) for n in counts], indexing="ij"), axis=-1).reshape(-1, 3)
    places = (index + 0.5) * spacing - np.array([counts[0], counts[1], 0]) * spacing / 2 + np.asarray(bottom)
    return BodyParticles(
        name=name,
        positions=places,
        volumes=np.full(len(places), spacing**3),
        material=material,
        contact_radii=np.full(len(places), spacing / 2),
        **{key: value(places) if callable(value) else value for key, value in fields.items()},
    )


@pytest.fixture
def box_body() -> BoxFactory:
    return rigid_box


@pytest.fixture
def ball_body() -> BoxFactory:
    return rigid_ball


@pytest.fixture
def rigid_bodies() -> Callable[..., RigidBodies]:
    """A factory of rigid bodies: worlds of 32 cells a metre around the origin."""

    def make(*setups: WorldSetup) -> RigidBodies:
        runtime.ensure_started(SolverOptions(grid=GRID, arch=ARCH))
        return RigidBodies(setups, [1.0 / CELL] * len(setups), [(-1.0, -1.0, -1.0)] * len(setups))

    return make


@pytest.fixture
def block() -> Block:
    return lattice_block


def set_motion(world: World, velocities: np.ndarray, gradients: np.ndarray) -> None:
    """Velocities (N, 3) in m/s and velocity gradients (N, 3, 3) for body 0, in the order of its particles."""
    state = world.checkpoint()
    order = state["ids"]
    scale = world.options.grid / 2.0 * world.similarity.scale
    state["v"] = (velocities[order] * scale).astype(np.float32)
    state["C"] = gradients[order].astype(np.float32)
    world.restore(state)


@pytest.fixture
def give_motion() -> GiveMotion:
    return set_motion
