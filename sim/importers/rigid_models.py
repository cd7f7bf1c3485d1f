# SPDX-License-Identifier: MIT
"""MJCF (MuJoCo) and URDF files → rigid bodies: shapes, mass, centre and inertia, friction.

Joints are not simulated: what hangs on a body by joints is frozen as the file places it and counts as part of it.
"""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from pathlib import Path

import numpy as np

from ..errors import InputError
from ..files import read_text
from .mjcf import MjcfReader
from .rigid_parts import MAX_PARTS, RigidModel
from .urdf import UrdfReader

SUFFIXES = (".xml", ".mjcf", ".urdf")
MAX_BYTES = 16 * 2**20


def read_rigid_model(path: Path) -> RigidModel:
    """Return the bodies in the MJCF or URDF file ``path``, with its meshes in its folder or below.

    Raises InputError for damaged files, entities, parts that are not read, and numbers that are not finite.
    """
    try:
        text = read_text(path, MAX_BYTES, what="model")
    except FileNotFoundError:
        raise InputError(f"{path}: there is no such file; check its name") from None
    if "<!DOCTYPE" in text or "<!ENTITY" in text:
        raise InputError(f"{path}: declares entities, which no model needs; remove them")
    try:
        root = ElementTree.fromstring(text)  # noqa: S314  entities are refused above
    except (ElementTree.ParseError, ValueError) as error:
        raise InputError(f"{path}: not readable as XML ({error})") from None
    if root.tag not in ("mujoco", "robot"):
        raise InputError(f"{path}: its root is {root.tag[:40]!r}: give a model of MuJoCo (mujoco) or URDF (robot)")
    if sum(1 for _ in root.iter()) > 20 * MAX_PARTS:
        raise InputError(f"{path}: has more than {20 * MAX_PARTS} elements; split the model")
    reader = MjcfReader(path, root) if root.tag == "mujoco" else UrdfReader(path, root)
    with np.errstate(all="ignore"):
        model = reader.read()
    if not model.bodies:
        raise InputError(f"{path}: has no body with a shape; add geoms (or visuals and collisions)")
    for body in model.bodies:
        weight = [body.inertia.mass, *body.inertia.centre, *body.inertia.tensor.ravel()]
        if not (np.isfinite(weight).all() and np.abs(body.vertices).max() < 1e6):
            raise InputError(f"{path}: body {body.name!r} has numbers that are not finite, or beyond 1,000 km")
        if body.free and not 1e-9 < body.inertia.mass < 1e9:
            raise InputError(f"{path}: body {body.name!r} has a mass of {body.inertia.mass:.3g} kg: give one above 0")
    return model
