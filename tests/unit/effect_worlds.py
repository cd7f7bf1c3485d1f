# SPDX-License-Identifier: MIT
"""Worlds for the tests of effects: a jelly block, a die, and a world with some of everything."""

import dataclasses
from pathlib import Path

import numpy as np
from hypothesis import strategies as st
from physgen.sim.constitutive import (
    ElasticMaterial,
    FluidMaterial,
    NeoHookeanMaterial,
    RigidMaterial,
)
from physgen.sim.effects.registry import effect
from physgen.sim.mpm.bodies import BodyForces, BodyParticles
from physgen.sim.mpm.colliders import Collider, Surface, Track
from physgen.sim.mpm.solver_options import Ground
from physgen.sim.mpm.surface_contact import ContactTable, SurfaceContact
from physgen.sim.mpm.world_setup import WorldSetup

ROOT = Path(__file__).resolve().parents[2]
VOCABULARY = {
    "force": ("air_drag", "wind", "magnus", "buoyancy", "gravity_tilt", "tether"),
    "contact": ("friction", "restitution", "rolling_resistance", "adhesion"),
    "material": ("stiffness", "internal_damping", "plastic_yield", "anisotropy", "stiffness_gradient", "sandy"),
    "mass": ("mass_offset", "inertia"),
    "observation": ("time_scale", "camera_pose"),
}
NAMES = [name for names in VOCABULARY.values() for name in names]
NO_NEUTRAL = ("plastic_yield", "sandy")
SOLID = {"density": 800.0, "youngs_modulus": 1e5, "poisson_ratio": 0.3}
JELLY = ElasticMaterial(**SOLID, damping_time=1e-4)
BOX = Surface(
    vertices=np.array([[x, y, z] for x in (0.0, 1.0) for y in (0.0, 1.0) for z in (0.0, 1.0)]),
    faces=np.array([[0, 1, 2]]),
)


def body(name="jelly", material=JELLY, *, cells=(5, 4, 3), **changes):
    """A block with 1 cm a particle, its corner at (0.3, 0, 0.1)."""
    axes = [0.01 * (np.arange(n) + 0.5) for n in cells]
    positions = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3) + np.array([0.3, 0.0, 0.1])
    surface = BOX if isinstance(material, RigidMaterial) else None
    volumes = np.full(len(positions), 1e-6)
    return BodyParticles(
        **{
            "name": name,
            "positions": positions,
            "volumes": volumes,
            "material": material,
            "surface": surface,
            **changes,
        }
    )


def die(name="die", **changes):
    return body(name, RigidMaterial(density=1200.0), **changes)


def world(*bodies, **changes):
    ground = Ground(friction=0.3, static_friction=0.45, restitution=0.2)
    return WorldSetup(**{"bodies": bodies or (body(), die()), "ground": ground, **changes})


def rich_world():
    """Something of everything, so that whatever an effect might touch is there to be touched."""
    mixed = body(
        "mixed",
        materials=(FluidMaterial(density=1000.0, bulk_modulus=1e5, viscosity=0.0), NeoHookeanMaterial(**SOLID)),
        material_index=np.arange(60) % 3,
        density_scale=np.linspace(0.5, 2.0, 60),
        stiffness_scale=np.linspace(0.8, 1.2, 60),
        material_track=((3.0, 1),),
        forces=BodyForces(drag=0.01, wind=(1.0, 0.0, 0.0), lift=0.1, gravity_factor=0.9),
    )
    return world(
        body(),
        die(),
        mixed,
        gravity_track=Track(times=np.array([0.0, 1.0]), values=np.array([[0.0, 0.0, -9.81], [1.0, 0.0, -5.0]])),
        colliders=(Collider(name="table", surface=BOX),),
        contacts=ContactTable().with_pair("jelly", "table", SurfaceContact(friction=0.7, static_friction=0.9)),
    )


def same(a, b):
    """Whether two values are equal to the last bit, dataclasses by their fields."""
    if dataclasses.is_dataclass(a):
        return type(a) is type(b) and all(same(getattr(a, f.name), getattr(b, f.name)) for f in dataclasses.fields(a))
    if isinstance(a, np.ndarray):
        return a.dtype == b.dtype and a.shape == b.shape and a.tobytes() == b.tobytes()
    if isinstance(a, tuple):
        return len(a) == len(b) and all(same(x, y) for x, y in zip(a, b, strict=True))
    return a == b


def close(a, b):
    """The same within rounding."""
    if dataclasses.is_dataclass(a):
        return type(a) is type(b) and all(close(getattr(a, f.name), getattr(b, f.name)) for f in dataclasses.fields(a))
    if isinstance(a, tuple):
        return len(a) == len(b) and all(close(x, y) for x, y in zip(a, b, strict=True))
    if isinstance(a, np.ndarray | float):
        return np.allclose(a, b, rtol=1e-9, atol=1e-15)
    return a == b


def good_values(item):
    """Values in range: hypothesis draws them."""
    drawn = {}
    for parameter in item.parameters:
        numbers = st.floats(parameter.low, parameter.high)
        drawn[parameter.name] = st.sampled_from([0.0, 1.0]) if parameter.whole else numbers
    return st.fixed_dictionaries(drawn)


def put(setup, name, bodies=None, **changes):
    return effect(name).apply(setup, {**effect(name).defaults, **changes}, bodies=bodies)
