# SPDX-License-Identifier: MIT
"""Input of tracking: options, videos, what a user knows of a filmed body, and a scene folder as a capture has it.

A filmed body has a shape and a size: ``ball:diameter=0.04,mass=0.0027``. Of a scene folder camera, ground and objects
are taken; an object's rest frame has the world's axes, with its origin in the middle of the object's bounding box in
the scene.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np

from ...constitutive import COHERENT, FLUID, GRANULAR, cohesion_of
from ...errors import InputError
from ...mpm.surface_contact import GROUND_NAME, ContactTable
from ...scene.folder import Scene
from ...scene.meshes import load_object_mesh
from ...scene.model import SceneModel, SceneObject
from ..capture import Camera, CaptureObject, Ground, ObjectBelief
from .pose_estimation import Array, Pose, Surface

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

    def capture_object(self, on_rim: bool = False) -> CaptureObject:
        """Return the body with its mesh, centred on its middle. Raises InputError for an unreadable mesh.

        on_rim: a cylinder lies, with its axis along y.
        """
        import trimesh

        if self.kind == "ball":
            assert self.diameter is not None
            mesh = trimesh.creation.icosphere(subdivisions=3, radius=self.diameter / 2)
            volume = math.pi * self.diameter**3 / 6
        elif self.kind == "cylinder":
            assert self.diameter is not None and self.height is not None
            mesh = trimesh.creation.cylinder(radius=self.diameter / 2, height=self.height, sections=16)
            if on_rim:
                mesh = trimesh.creation.cylinder(radius=self.diameter / 2, height=self.height, sections=48)
                mesh.apply_transform(trimesh.transformations.rotation_matrix(math.pi / 2, (1, 0, 0)))
            volume = math.pi * self.diameter**2 / 4 * self.height
        elif self.kind == "box":
            mesh = trimesh.creation.box(extents=[float(v or 0.0) for v in (self.x, self.y, self.z)])
            volume = float(mesh.volume)
        else:
            from ...scene.meshes import read_mesh

            assert self.file is not None
            read = read_mesh(self.file, textures=False)
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


@dataclass(frozen=True, kw_only=True)
class TrackOptions:
    """Options of selecting, tracking and dropping points. Pixels are those of the video.

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
    # Imported here: reading the options does not need it.
    from ...mpm.scene_contacts import contact_table

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
