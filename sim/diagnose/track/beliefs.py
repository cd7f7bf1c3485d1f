# SPDX-License-Identifier: MIT
"""What a scene folder says of a recording of it: camera, ground, objects, as a capture has them.

An object's rest frame has the world's axes, with its origin in the middle of the object's bounding box where the scene
has it: what a diagnosis says along the axes of the rest frame then holds for the scene as it stands.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from ...app.setup_contacts import contact_table
from ...errors import InputError
from ...mpm.contacts import GROUND_NAME
from ...scene.folder import SceneFolder
from ...scene.meshes import load_object_mesh
from ...scene.model import Scene, SceneObject
from ..capture import Camera, CaptureObject, Ground, ObjectBelief
from .pose import Array, Pose
from .surface import Surface

SOFT_BELOW_PA, HARD_FROM_PA = 2e5, 2e6
"""Young's moduli between those of the presets soft, medium and hard (geometric means, rounded)."""

ASPECT_TOLERANCE = 0.01
"""Relative difference of aspects that rounding to whole pixels explains."""


@dataclass(frozen=True, kw_only=True)
class SceneBody:
    """An object of a scene in its rest frame. middle: (3,) world metres, where the scene has the frame's origin."""

    source: SceneObject
    surface: Surface
    middle: Array

    def pose(self, camera: Camera) -> Pose:
        """Where the scene has it."""
        world_from_camera = camera.matrix
        turn = world_from_camera[:3, :3]
        return Pose(rotation=turn.T.copy(), translation=turn.T @ (self.middle - world_from_camera[:3, 3]))

    @property
    def rigid(self) -> bool:
        """Whether it barely deforms, so that a pose alone says where its points are."""
        return self.source.material.law == "rigid" or self.source.material.youngs_modulus >= HARD_FROM_PA


def scene_bodies(folder: SceneFolder) -> list[SceneBody]:
    """All objects of the scene, in its order. Raises InputError for a mesh that cannot be read."""
    bodies = []
    for item in folder.scene.objects:
        mesh = load_object_mesh(folder, item)
        middle = (mesh.vertices.min(axis=0) + mesh.vertices.max(axis=0)) / 2
        surface = Surface(vertices=mesh.vertices - middle, faces=mesh.faces)
        bodies.append(SceneBody(source=item, surface=surface, middle=middle))
    return bodies


def chosen_objects(scene: Scene, names: Sequence[str]) -> list[int]:
    """Indices of the scene's objects called ``names``; without names, of those that move."""
    known = [item.name for item in scene.objects]
    for name in names:
        if name not in known:
            raise InputError(f"--objects: the scene has no object {name!r}; choose from {', '.join(known)}")
    found = [i for i, item in enumerate(scene.objects) if (item.name in names if names else item.role == "dynamic")]
    if not found:
        raise InputError("no object of the scene moves; name some with --objects")
    for i in found:
        if scene.objects[i].material.law == "fluid":
            raise InputError(
                f"object {known[i]!r}: is a fluid, whose surface does not stay what it is; name others with --objects"
            )
    return found


def video_camera(scene: Scene, width: int, height: int, where: str) -> Camera:
    """The scene's camera at the resolution of a video. Raises InputError when the shapes differ."""
    camera = scene.camera
    ratio = (width / height) / (camera.width / camera.height)
    if abs(ratio - 1) > ASPECT_TOLERANCE:
        raise InputError(
            f"{where}: its frames are {width}x{height} pixels and the scene's photo {camera.width}x{camera.height}: "
            "another shape, so another crop of the view; reconstruct the scene from a frame of the video"
        )
    x, y = width / camera.width, height / camera.height
    return Camera(
        width=width,
        height=height,
        fx=camera.fx * x,
        fy=camera.fy * y,
        cx=camera.cx * x,
        cy=camera.cy * y,
        world_from_camera=camera.world_from_camera,
    )


def believed_objects(bodies: Sequence[SceneBody]) -> tuple[CaptureObject, ...]:
    """The bodies as objects of a capture."""
    return tuple(
        CaptureObject(belief=_belief(body.source), vertices=body.surface.vertices, faces=body.surface.faces)
        for body in bodies
    )


def _belief(item: SceneObject) -> ObjectBelief:
    material = item.material
    mesh = f"meshes/{item.name}.obj"
    if material.law == "rigid":
        return ObjectBelief(name=item.name, mesh=mesh, density_kg_m3=_density(item), stiffness="hard")
    modulus = material.youngs_modulus
    return ObjectBelief(
        name=item.name,
        mesh=mesh,
        density_kg_m3=_density(item),
        stiffness="soft" if modulus < SOFT_BELOW_PA else "medium" if modulus < HARD_FROM_PA else "hard",
        youngs_modulus_pa=modulus,
        poisson_ratio=material.poisson_ratio,
    )


def _density(item: SceneObject) -> float:
    return item.material.density


def believed_ground(scene: Scene, objects: Sequence[SceneObject]) -> Ground:
    """The ground as the first of ``objects`` meets it: a capture has one friction and one restitution for all."""
    if scene.ground is None:
        raise InputError(
            "the scene has no ground, which a capture needs: give it one, below all objects if none hits it"
        )
    contact = contact_table(scene).between(objects[0].name, GROUND_NAME)
    return Ground(
        point=scene.ground.point,
        normal=scene.ground.normal,
        friction=contact.friction,
        restitution=contact.restitution,
    )


def belief_warnings(scene: Scene, chosen: Sequence[int]) -> list[str]:
    """What of the scene a capture cannot say."""
    warnings = []
    table = contact_table(scene)
    meetings = {
        (table.between(scene.objects[i].name, GROUND_NAME).friction,
         table.between(scene.objects[i].name, GROUND_NAME).restitution)
        for i in chosen
    }  # fmt: skip
    if len(meetings) > 1:
        warnings.append(
            "the objects meet the ground with different friction or restitution; a capture has one of each, "
            f"those of {scene.objects[chosen[0]].name!r} are taken"
        )
    if scene.gravity_track:
        warnings.append("the scene's gravity changes over time; a capture has one gravity, 'gravity' is taken")
    for i in chosen:
        item = scene.objects[i]
        if item.material.law in ("snow", "sand"):
            warnings.append(f"object {item.name!r}: is {item.material.law}; a capture knows elastic and rigid matter")
        if not item.fill:
            warnings.append(f"object {item.name!r}: is hollow; a capture takes its density through the whole inside")
    left = [o.name for i, o in enumerate(scene.objects) if o.role == "dynamic" and i not in chosen]
    if left:
        warnings.append(f"not tracked: {', '.join(left)}; what hits them is a cause that a diagnosis cannot know")
    return warnings
