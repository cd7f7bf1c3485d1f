# SPDX-License-Identifier: MIT
"""Particles of what deforms, in a USD stage, as Newton's material point method reads them.

UsdPhysics has no deformable matter. The schemas written here, ``NewtonMPMSceneAPI``, ``NewtonMPMMaterialAPI`` and
``NewtonPointsDeformableSimAPI``, are those that newton-physics 1.8 imports (its ``ModelBuilder.add_usd``); a program
that does not know them sees points of purpose ``guide``.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from ..errors import InputError
from ..mpm.bodies import BodyParticles
from ..scene.folder import Scene
from ..scene.material import Material
from ..scene.meshes import load_object_mesh
from .bake_options import BakeOptions
from .scene_to_world import PreparedWorld, prepare_world

ELASTIC = ("fixed_corotated", "neo_hookean")


def prepared_particles(scene: Scene) -> tuple[PreparedWorld | None, str]:
    """Return the bodies of ``scene`` as a bake of default quality begins with them, or None where nothing deforms;
    where it cannot be baked as it is, None and why."""
    if all(item.role != "dynamic" or item.material.law == "rigid" for item in scene.model.objects):
        return None, ""
    try:
        meshes = [load_object_mesh(scene, item) for item in scene.model.objects]
        return prepare_world(scene, meshes, BakeOptions(), check_surfaces=False), ""
    except InputError as error:
        return None, str(error)


def mpm_material(material: Material) -> dict[str, float]:
    """Return the attributes of Newton's material, without their prefix ``newton:mpm:``, in SI units.

    Elastic laws yield nowhere, sand at its angle and in tension, clay at its yield stress. Of snow only stiffness and
    density are said, of fluids the viscosity: Newton's are incompressible.
    """
    if material.law == "fluid":
        return {"internalFriction": 0.0, "tensileYieldRatio": 0.0, "viscosity": material.viscosity}
    found = {
        "youngsModulus": material.youngs_modulus,
        "poissonsRatio": material.poisson_ratio,
        # Pa s: Newton's damping is a viscosity, ours the time over which it acts.
        "elasticDamping": material.youngs_modulus * material.damping_time,
    }
    if material.law == "sand":
        return {**found, "internalFriction": math.tan(material.friction_angle), "tensileYieldRatio": 0.0}
    if material.law == "von_mises":
        # Newton's bound is one of shear stress.
        shear = material.yield_stress / math.sqrt(3)
        return {**found, "internalFriction": 0.0, "tensileYieldRatio": 1.0, "yieldStress": shear}
    return {**found, "tensileYieldRatio": 1.0}


def is_whole(material: Material) -> bool:
    """Return whether ``mpm_material`` says all of ``material``'s law."""
    extras = material.relaxing_share > 0 or material.fibre_modulus > 0
    return material.law in ("sand", "von_mises") or (material.law in ELASTIC and not extras)


def write_scene(prim: Any, prepared: PreparedWorld) -> None:
    """Make the physics scene ``prim`` one of Newton's solver, with the cells of the bake."""
    from pxr import Sdf

    prim.AddAppliedSchema("NewtonMPMSceneAPI")
    cell = prepared.solver.cell_size(prepared.similarity)
    prim.CreateAttribute("newton:mpm:voxelSize", Sdf.ValueTypeNames.Float).Set(cell)


def write_particles(stage: Any, path: str, body: BodyParticles, material: Material, bound: Any) -> None:
    """Write the particles of ``body`` as points at ``path``, world metres at rest, with their motion and masses.

    bound: the prim of its USD material, which gets the attributes of ``mpm_material``.
    """
    from pxr import Sdf, UsdGeom, UsdPhysics, Vt

    points = UsdGeom.Points.Define(stage, path)
    prim = points.GetPrim()
    for schema in ("NewtonPointsDeformableSimAPI", "PhysicsDeformableBodyAPI"):
        prim.AddAppliedSchema(schema)
    points.CreatePurposeAttr(UsdGeom.Tokens.guide)
    places, masses = np.asarray(body.positions), body.masses
    centre = np.average(places, axis=0, weights=masses)
    velocities = np.asarray(body.velocity) + np.cross(np.asarray(body.spin), places - centre)
    points.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(places.astype(np.float32)))
    points.CreateVelocitiesAttr(Vt.Vec3fArray.FromNumpy(velocities.astype(np.float32)))
    extent = np.stack([places.min(axis=0), places.max(axis=0)])
    points.CreateExtentAttr(Vt.Vec3fArray.FromNumpy(extent.astype(np.float32)))
    # Newton takes a particle for a cube of its width.
    points.CreateWidthsAttr(Vt.FloatArray.FromNumpy(np.cbrt(body.volumes).astype(np.float32)))
    points.SetWidthsInterpolation(UsdGeom.Tokens.vertex)
    kind = Sdf.ValueTypeNames.FloatArray
    prim.CreateAttribute("physics:masses", kind).Set(Vt.FloatArray.FromNumpy(masses.astype(np.float32)))
    owner = UsdPhysics.Scene.Get(stage, "/World/physicsScene").GetPath()
    prim.CreateRelationship("physics:simulationOwner").SetTargets([owner])
    bound.AddAppliedSchema("NewtonMPMMaterialAPI")
    for name, value in mpm_material(material).items():
        bound.CreateAttribute(f"newton:mpm:{name}", Sdf.ValueTypeNames.Float).Set(float(value))
