# SPDX-License-Identifier: MIT
"""What a user knows of a filmed body: its shape and size, ``ball:diameter=0.04,mass=0.0027``."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np

from ...errors import InputError
from ..capture import CaptureObject, ObjectBelief

KINDS = {"ball": ("diameter",), "cylinder": ("diameter", "height"), "box": ("x", "y", "z"), "mesh": ("file",)}
"""Kind of body → the sizes it needs."""
USUAL_DENSITY = 700.0
"""kg/m³ where neither mass nor density is given: wood, hollow plastic, filled toys."""


@dataclass(frozen=True, kw_only=True)
class BodyRequest:
    """A body in a video without a scene.

    kind: ball, cylinder, box or mesh. diameter, height: m, of a ball or cylinder. x, y, z: edges of a box as it stands,
    m. file: mesh in m, z up. mass in kg or density in kg/m³; neither: 700 kg/m³. friction (0 to 10) and restitution
    (0 to 1): with what it touches, as believed. name: of the object.
    """

    kind: str
    diameter: float | None = None
    height: float | None = None
    x: float | None = None
    y: float | None = None
    z: float | None = None
    file: Path | None = None
    mass: float | None = None
    density: float | None = None
    friction: float = 0.5
    restitution: float = 0.5
    name: str = "body"

    def __post_init__(self) -> None:
        if self.kind not in KINDS:
            raise InputError(f"object {self.kind!r}: give one of {', '.join(KINDS)}")
        for name in KINDS[self.kind]:
            if getattr(self, name) is None:
                raise InputError(f"object {self.kind}: {name} is missing: give {example(self.kind)}")
        for name in ("diameter", "height", "x", "y", "z", "mass", "density"):
            value = getattr(self, name)
            if value is not None and not (math.isfinite(value) and 1e-5 <= value <= 1e5):
                raise InputError(f"object {self.kind}: {name} is {value!r}: give metres, kg or kg/m³ above 0")
        sizes = [getattr(self, name) for name in KINDS[self.kind] if name != "file"]
        if sizes and max(sizes) > 20:
            raise InputError(f"object {self.kind}: a size of {max(sizes):g} m, probably millimetres: give metres")
        if self.mass is not None and self.density is not None:
            raise InputError(f"object {self.kind}: give mass or density, not both")
        if not 0 <= self.friction <= 10:
            raise InputError(f"object {self.kind}: friction is {self.friction!r}: give 0 to 10")
        if not 0 <= self.restitution <= 1:
            raise InputError(f"object {self.kind}: restitution is {self.restitution!r}: give 0 to 1")

    def capture_object(self) -> CaptureObject:
        """Return the body with its mesh, centred on its middle. Raises InputError for an unreadable mesh."""
        import trimesh

        if self.kind == "ball":
            assert self.diameter is not None
            mesh = trimesh.creation.icosphere(subdivisions=3, radius=self.diameter / 2)
            volume = math.pi * self.diameter**3 / 6
        elif self.kind == "cylinder":
            assert self.diameter is not None and self.height is not None
            mesh = trimesh.creation.cylinder(radius=self.diameter / 2, height=self.height, sections=16)
            volume = math.pi * self.diameter**2 / 4 * self.height
        elif self.kind == "box":
            mesh = trimesh.creation.box(extents=[float(v or 0.0) for v in (self.x, self.y, self.z)])
            volume = float(mesh.volume)
        else:
            from ...scene.meshes import read_mesh

            assert self.file is not None
            read = read_mesh(self.file)
            mesh = trimesh.Trimesh(read.vertices, read.faces, process=False)
            volume = abs(float(mesh.volume))
        density = self.density or (USUAL_DENSITY if self.mass is None else self.mass / max(volume, 1e-12))
        if not 0.01 <= density <= 30000:
            raise InputError(f"object {self.kind}: mass and size give {density:.3g} kg/m³: check kg and m")
        vertices = np.asarray(mesh.vertices, dtype=np.float64)
        vertices = vertices - (vertices.min(axis=0) + vertices.max(axis=0)) / 2
        belief = ObjectBelief(name=self.name, mesh=f"{self.name}.obj", density_kg_m3=density, stiffness="hard")
        return CaptureObject(belief=belief, vertices=vertices, faces=np.asarray(mesh.faces, dtype=np.int64))


def example(kind: str) -> str:
    """Return how an object of ``kind`` is written."""
    return f"{kind}:" + ",".join(f"{name}={'body.obj' if name == 'file' else '0.05'}" for name in KINDS[kind])


def parse_body(text: str) -> BodyRequest:
    """Return the body that ``text`` describes, such as ``cylinder:diameter=0.03,height=0.01,mass=0.02``.

    Raises InputError naming what is wrong and how it is written.
    """
    kind, _, rest = text.partition(":")
    if kind not in KINDS:
        raise InputError(f"--object {text!r}: start with {', '.join(KINDS)}, such as {example('ball')}")
    known = {f.name for f in fields(BodyRequest)} - {"kind"}
    values: dict[str, object] = {}
    for part in filter(None, rest.split(",")):
        key, equals, value = part.partition("=")
        if not equals or key not in known:
            raise InputError(f"--object {text!r}: {part!r}: write NAME=VALUE with {', '.join(sorted(known))}")
        if key == "file":
            values[key] = Path(value)
        elif key == "name":
            if not value.replace("_", "").isalnum():
                raise InputError(f"--object {text!r}: name {value!r}: letters, digits and _ only")
            values[key] = value
        else:
            try:
                values[key] = float(value)
            except ValueError:
                raise InputError(f"--object {text!r}: {key} is {value!r}: give a number in metres or kg") from None
    return BodyRequest(kind=kind, **values)  # type: ignore[arg-type]
