# SPDX-License-Identifier: MIT
"""Input of tracking: options, videos, and the camera, ground and objects of a scene folder as a capture has them.

An object's rest frame has the world's axes, with its origin in the middle of the object's bounding box in the scene."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from ...constitutive import COHERENT, FLUID, GRANULAR, cohesion_of
from ...errors import InputError
from ...mpm.surface_contact import GROUND_NAME, ContactTable
from ...scene.folder import Scene
from ...scene.meshes import load_object_mesh
from ...scene.model import SceneModel, SceneObject
from ..capture import Camera, CaptureObject, Ground, ObjectBelief
from .pose_estimation import Array, Pose, Surface


@dataclass(frozen=True, kw_only=True)
class TrackOptions:
    """How points are selected, tracked and dropped. Pixels are those of the video.

    density: target number of points per object, 6 to 500.
    min_contrast: grey levels per pixel, 0.1 to 50; RMS gradient of a patch along its weakest direction below which it
        is no corner. It must also exceed twice the gradient of the frame's noise.
    min_score: 0.3 to 0.99; zero-mean normalised correlation of a patch with its warped reference below which the point
        counts as occluded.
    max_round_trip_px: 0.1 to 10; largest forward-backward error of a tracked point.
    rigid_tolerance_px: 0.2 to 50; least distance from the fitted pose at which a point counts as an outlier. Larger
        for a mesh that fits the object badly, with a warning.
    """

    density: int = 40
    min_contrast: float = 2.0
    min_score: float = 0.7
    max_round_trip_px: float = 1.0
    rigid_tolerance_px: float = 1.0

    def __post_init__(self) -> None:
        for name, low, high in (
            ("density", 6, 500),
            ("min_contrast", 0.1, 50.0),
            ("min_score", 0.3, 0.99),
            ("max_round_trip_px", 0.1, 10.0),
            ("rigid_tolerance_px", 0.2, 50.0),
        ):
            value = getattr(self, name)
            if not (math.isfinite(value) and low <= value <= high):
                raise InputError(f"{name} is {value!r}: give {low:g} to {high:g}")


@dataclass(frozen=True, kw_only=True)
class VideoTrial:
    """One video and the part of it to use.

    start_frame, end_frame: frames of the file from 0, inclusive; None: the last.
    fps_override: true frame rate, 1 to 100000, where the file is played slower or has wrong times; None: the file's
        own times.
    predict_from: s after the start frame from which the motion is withheld, to be predicted; None: nothing.
    """

    path: Path
    name: str = ""
    start_frame: int = 0
    end_frame: int | None = None
    fps_override: float | None = None
    predict_from: float | None = None

    def __post_init__(self) -> None:
        where = f"{self.path}"
        if self.start_frame < 0:
            raise InputError(f"{where}: start_frame is {self.start_frame}: frames count from 0")
        if self.end_frame is not None and self.end_frame < self.start_frame + 2:
            raise InputError(
                f"{where}: end_frame is {self.end_frame}: a motion needs 3 frames, so give at least "
                f"{self.start_frame + 2}"
            )
        fps = self.fps_override
        if fps is not None and not (math.isfinite(fps) and 1 <= fps <= 1e5):
            raise InputError(f"{where}: fps_override is {fps!r}: give 1 to 100000 frames per second")
        if self.predict_from is not None and not (math.isfinite(self.predict_from) and self.predict_from > 0):
            raise InputError(f"{where}: predict_from is {self.predict_from!r}: give seconds above 0")

    @property
    def trial_name(self) -> str:
        """Return ``name``, or else the file name without its suffix."""
        return self.name or self.path.stem


SOFT_BELOW_PA, HARD_FROM_PA = 2e5, 2e6
"""Young's moduli between those of the presets soft, medium and hard (geometric means, rounded)."""

ASPECT_TOLERANCE = 0.01
"""Relative difference of aspect ratios explained by rounding to whole pixels."""


@dataclass(frozen=True, kw_only=True)
class SceneBody:
    """An object of a scene in its rest frame. middle: (3,) m, world position of the frame's origin in the scene."""

    source: SceneObject
    surface: Surface
    middle: Array

    def pose(self, camera: Camera) -> Pose:
        """Return its scene pose."""
        world_from_camera = camera.matrix
        turn = world_from_camera[:3, :3]
        return Pose(rotation=turn.T.copy(), translation=turn.T @ (self.middle - world_from_camera[:3, 3]))

    @property
    def rigid(self) -> bool:
        """Return whether it barely deforms, so that a pose determines its points."""
        return self.source.material.law == "rigid" or self.source.material.youngs_modulus >= HARD_FROM_PA


def scene_bodies(folder: Scene) -> list[SceneBody]:
    """Return all objects of the scene, in its order. Raises InputError for an unreadable mesh."""
    bodies = []
    for item in folder.model.objects:
        mesh = load_object_mesh(folder, item)
        middle = (mesh.vertices.min(axis=0) + mesh.vertices.max(axis=0)) / 2
        surface = Surface(vertices=mesh.vertices - middle, faces=mesh.faces)
        bodies.append(SceneBody(source=item, surface=surface, middle=middle))
    return bodies


def selected_objects(scene: SceneModel, names: Sequence[str]) -> list[int]:
    """Return the indices of the objects ``names``; without names, of those that move."""
    known = [item.name for item in scene.objects]
    for name in names:
        if name not in known:
            raise InputError(f"--objects: the scene has no object {name!r}; choose from {', '.join(known)}")
    found = [i for i, item in enumerate(scene.objects) if (item.name in names if names else item.role == "dynamic")]
    if not found:
        raise InputError("no object of the scene moves; name some with --objects")
    for i in found:
        if cohesion_of(scene.objects[i].material.law) == FLUID:
            raise InputError(f"object {known[i]!r}: is a fluid, which has no fixed surface; name others with --objects")
    return found


def video_camera(scene: SceneModel, width: int, height: int, where: str) -> Camera:
    """Return the scene's camera at the resolution of a video. Raises InputError when the aspect ratios differ."""
    camera = scene.camera
    ratio = (width / height) / (camera.width / camera.height)
    if abs(ratio - 1) > ASPECT_TOLERANCE:
        raise InputError(
            f"{where}: its frames are {width}x{height} pixels and the scene's photo {camera.width}x{camera.height}: "
            "another aspect ratio, so another crop of the view; reconstruct the scene from a frame of the video"
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
    """Return the bodies as objects of a capture."""
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


def _contacts(scene: SceneModel) -> ContactTable:
    # Imported here: it pulls in the preparation of worlds, which reading the options does not need.
    from ...app.world_setup import contact_table

    return contact_table(scene)


def believed_ground(scene: SceneModel, objects: Sequence[SceneObject]) -> Ground:
    """Return the ground with the contact coefficients of the first of ``objects``: a capture has one set for all."""
    if scene.ground is None:
        raise InputError("the scene has no ground, which a capture needs: add one, below all objects if none hits it")
    contact = _contacts(scene).between(objects[0].name, GROUND_NAME)
    return Ground(
        point=scene.ground.point,
        normal=scene.ground.normal,
        friction=contact.friction,
        restitution=contact.restitution,
    )


def belief_warnings(scene: SceneModel, chosen: Sequence[int]) -> list[str]:
    """Return warnings about what a capture cannot represent of the scene."""
    warnings = []
    table = _contacts(scene)
    meetings = {
        (table.between(scene.objects[i].name, GROUND_NAME).friction,
         table.between(scene.objects[i].name, GROUND_NAME).restitution)
        for i in chosen
    }  # fmt: skip
    if len(meetings) > 1:
        warnings.append(
            "the objects have different friction or restitution with the ground; a capture has one of each, "
            f"those of {scene.objects[chosen[0]].name!r} are taken"
        )
    if scene.gravity_track:
        warnings.append("the scene's gravity changes over time; a capture has one gravity, 'gravity' is taken")
    for i in chosen:
        item = scene.objects[i]
        if item.material.law != "rigid":
            warnings.append(
                f"object {item.name!r}: deforms, and from videos only rigid objects can be diagnosed; give it a rigid "
                "material (wood, metal) if it keeps its shape"
            )
        if cohesion_of(item.material.law) in (COHERENT, GRANULAR):
            warnings.append(
                f"object {item.name!r}: is {item.material.law}; a capture has elastic and rigid materials only"
            )
        if not item.fill:
            warnings.append(f"object {item.name!r}: is hollow; a capture assumes uniform density inside")
    left = [o.name for i, o in enumerate(scene.objects) if o.role == "dynamic" and i not in chosen]
    if left:
        warnings.append(f"not tracked: {', '.join(left)}; contact with them cannot be identified as a cause")
    return warnings
