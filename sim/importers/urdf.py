# SPDX-License-Identifier: MIT
"""URDF, the robot descriptions of ROS → rigid bodies. Source: wiki.ros.org/urdf/XML."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator, Mapping

import numpy as np
from numpy.typing import NDArray

from .rigid_parts import (
    SIZES,
    Array,
    BodyParts,
    Inertia,
    ModelReader,
    RigidModel,
    pose_matrix,
    rotation_matrix,
    shape_mesh,
)


class UrdfReader(ModelReader):
    """Reads one file: links hung together by joints, each root a body of its own."""

    def read(self) -> RigidModel:
        """Return the model. Raises InputError, as every method here, for what is wrong or not read."""
        links = {item.get("name", ""): item for item in self.root.findall("link")}
        joints: dict[str, list[tuple[str, Array, str]]] = {}
        children = set()
        for item in self.root.findall("joint"):
            parent, child = (
                (end.get("link", "") if (end := item.find(tag)) is not None else "") for tag in ("parent", "child")
            )
            if parent not in links or child not in links or child in children:
                raise self.fail(f"joint {item.get('name', '')[:60]!r} has no parent or child, or its child has two")
            children.add(child)
            joints.setdefault(parent, []).append((child, self._origin(item), item.get("type", "fixed")))
        roots = [name for name in links if name not in children]
        bodies: list[BodyParts] = []
        for name in roots:
            free = name != "world"
            owner = BodyParts(name=name or "body", free=free)
            bodies.append(owner)
            for link, pose in self._below(name, joints, owner):
                self._link(links[link], pose, owner)
        found = [body for each in bodies if (body := each.body(self.path)) is not None]
        if found:
            low = min(float(body.vertices[:, 2].min()) for body in found)
            if any(body.free for body in found) and low != 0:
                self.notes.append(f"URDF has no ground: moved up by {-low:.4g} m onto z = 0")
                for body in found:
                    body.vertices = body.vertices - [0, 0, low]
                    body.inertia = body.inertia.placed(pose_matrix(np.eye(3), np.array([0.0, 0.0, -low])))
        return RigidModel(bodies=found, notes=self.notes)

    def _below(
        self, name: str, joints: Mapping[str, list[tuple[str, Array, str]]], owner: BodyParts
    ) -> Iterator[tuple[str, Array]]:
        waiting = [(name, np.eye(4))]
        while waiting:
            link, pose = waiting.pop()
            self.count()
            yield link, pose
            for child, origin, kind in joints.get(link, []):
                if kind != "fixed":
                    self.notes.append(f"the {kind[:20]} joint of {child[:60]} is frozen: it is part of {owner.name}")
                waiting.append((child, pose @ origin))

    def _origin(self, item: ElementTree.Element) -> Array:
        origin = item.find("origin")
        if origin is None:
            return np.eye(4)
        turn = rotation_matrix("xyz", self.numbers(origin, "rpy", 3, (0.0, 0.0, 0.0)))
        return pose_matrix(turn, self.numbers(origin, "xyz", 3, (0.0, 0.0, 0.0)))

    def _link(self, item: ElementTree.Element, pose: Array, owner: BodyParts) -> None:
        inertial = item.find("inertial")
        if inertial is not None:
            mass, tensor = inertial.find("mass"), inertial.find("inertia")
            weight = 0.0 if mass is None else float(self.numbers(mass, "value", 1, (0.0,))[0])
            moments: ElementTree.Element | dict[str, str] = {} if tensor is None else tensor
            xx, xy, xz, yy, yz, zz = (
                float(self.numbers(moments, key, 1, (0.0,))[0]) for key in ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
            )
            found = Inertia(mass=weight, tensor=np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]))
            owner.inertia += found.placed(pose @ self._origin(inertial))
        for tag in ("collision", "visual"):
            for shape in item.findall(tag):
                geometry = shape.find("geometry")
                if geometry is None or not len(geometry):
                    raise self.fail(f"a {tag} of {item.get('name', '')[:60]!r} has no geometry")
                vertices, faces = self._shape(geometry[0])
                at = pose @ self._origin(shape)
                owner.shapes.append((vertices @ at[:3, :3].T + at[:3, 3], faces, tag == "collision"))

    def _shape(self, item: ElementTree.Element) -> tuple[Array, NDArray[np.int64]]:
        self.count()
        if item.tag == "mesh":
            name = item.get("filename", "")
            if name.startswith("package://"):
                name = name.removeprefix("package://").partition("/")[2]
            return self.mesh(name, self.numbers(item, "scale", 3, (1.0, 1.0, 1.0)))
        if item.tag == "box":
            size = self.numbers(item, "size", 3, ()) / 2
        elif item.tag in ("cylinder", "sphere", "capsule"):
            size = np.append(self.numbers(item, "radius", 1, ()), self.numbers(item, "length", 1, ()) / 2)
        else:
            raise self.fail(f"geometry {item.tag[:40]!r} is not read: give box, cylinder, capsule, sphere or mesh")
        if len(size) < SIZES[item.tag] or not (size > 0).all():
            raise self.fail(f"a {item.tag} has no size above 0")
        return shape_mesh(item.tag, size)
