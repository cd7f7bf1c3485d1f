# SPDX-License-Identifier: MIT
"""A scene, and the motion of a bake, as USD: UsdPhysics bodies, meshes with texture coordinates, points, camera.

Metres, kilograms, +Z up; time codes are frames. pxr (usd-core, ``pip install 'physgen[usd]'``) is imported when it is
needed. Schemas: openusd.org, UsdPhysics, UsdGeom, UsdShade.
"""

from __future__ import annotations

import contextlib
import math
import unicodedata
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..atomic import replacing, write_bytes
from ..cache.bake_check import unchanged_bake
from ..cache.bake_folder import Bake, BakedObject
from ..errors import InputError
from ..events import IsCancelled, never
from ..files import is_file, shown
from ..folder_lock import lock_beside
from ..memory import ran_out
from ..mpm.scene_contacts import surface
from ..mpm.surface_contact import SurfaceContact
from ..scene.folder import SCENE_FILE, Scene, unchanged_scene
from ..scene.scene_object import SceneObject
from ..scene.shading import evenly_lit_mesh
from ..scene.textured_mesh import TexturedMesh
from .export_patch import prim_name
from .scene_bodies import Mass, mass_of
from .usd_motion import UsdMotion, UsdObject, extent, quaternion, vectors
from .usd_particles import is_whole, prepared_particles, write_particles, write_scene

Array = NDArray[np.float64]
ENDINGS = (".usda", ".usdc")
FOCAL_LENGTH = 35.0
"""Of the camera, tenths of a unit: only its ratio to the aperture counts."""
PICTURES = {b"\x89PNG": ".png", b"\xff\xd8\xff": ".jpg"}


def export_usd(
    scene: Scene, file: str | Path, *, bake: Bake | None = None, cancelled: IsCancelled = never
) -> tuple[str, ...]:
    """Write ``scene``, with the motion of ``bake``, to ``file`` (``.usda`` or ``.usdc``); return what USD lacks.

    Textures go into ``STEM_textures`` beside it, evenly lit where the scene says what light is in them. What moves as a
    rigid body has a pose a frame, everything else its points; time code n is frame n.

    >>> import physgen
    >>> physgen.export_usd(physgen.load_scene("scene"), "scene.usdc", bake=physgen.load_bake("bake"))  # doctest: +SKIP

    Raises InputError where usd-core is missing, the file exists, or the bake is of another scene; Cancelled.
    """
    file = Path(file)
    require_target(scene, bake, file, ENDINGS)
    if any(unicodedata.category(c) == "Cc" for c in file.stem):
        raise InputError(f"{shown(file)}: USD names no textures by control characters; choose another name")
    try:
        from pxr import Tf, Usd, UsdGeom, UsdPhysics
    except ImportError as error:
        if ran_out(error):
            raise
        raise InputError("export to USD needs usd-core: pip install 'physgen[usd]'") from None
    stage = Usd.Stage.CreateInMemory()
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.z)
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    UsdPhysics.SetStageKilogramsPerUnit(stage, 1.0)
    stage.SetDefaultPrim(UsdGeom.Xform.Define(stage, "/World").GetPrim())
    if bake is not None:
        stage.SetTimeCodesPerSecond(bake.manifest.fps)
        stage.SetFramesPerSecond(bake.manifest.fps)
        stage.SetStartTimeCode(bake.first_frame)
        stage.SetEndTimeCode(bake.last_frame)
    writer = _Writer(stage, scene, bake, file, cancelled)
    with unchanged_scene(scene), contextlib.nullcontext() if bake is None else unchanged_bake(bake):
        writer.write()
    # Only now: a texture or a file is never left of an export that failed.
    with new_file(file) as partial, _written(writer.pictures):
        try:
            good = stage.GetRootLayer().Export(str(partial))
        except Tf.ErrorException:
            good = False
        if not good:
            raise InputError(f"{file}: cannot be written; free space or choose another folder")
    return tuple(writer.notes)


def require_target(scene: Scene, bake: Bake | None, file: Path, endings: Sequence[str]) -> None:
    """Raise InputError where ``file`` has another suffix or is there already, or ``bake`` is of another scene."""
    if file.suffix.lower() not in endings:
        raise InputError(f"{file}: give a name that ends in {' or '.join(endings)}")
    if file.exists():
        raise InputError(f"{file}: is there already; choose another name")
    if bake is not None and bake.manifest.geometry_hash not in ("", scene.geometry_hash()):
        raise InputError(f"{bake.root}: is the bake of another scene than {scene.root}; bake this one")


@contextlib.contextmanager
def new_file(file: Path) -> Iterator[Path]:
    """Yield a temporary path that becomes ``file``. Raises InputError if that was written meanwhile."""
    with lock_beside(file), replacing(file) as partial:
        if file.exists():
            raise InputError(f"{file}: is there already, written meanwhile; choose another name")
        yield partial


@contextlib.contextmanager
def _written(pictures: dict[Path, bytes]) -> Iterator[None]:
    """Have ``pictures`` written; those that were not there before go again if this fails."""
    new = [path for path in pictures if not path.exists()]
    try:
        for path, content in pictures.items():
            path.parent.mkdir(parents=True, exist_ok=True)
            write_bytes(path, content)
        yield
    except BaseException:
        with contextlib.suppress(OSError):
            for path in new:
                path.unlink(missing_ok=True)
                # Unless there is something else in it.
                if not any(path.parent.iterdir()):
                    path.parent.rmdir()
        raise


class _Writer:
    """One export; ``pictures`` are written by the caller, ``notes`` are what USD cannot say."""

    def __init__(self, stage: Any, scene: Scene, bake: Bake | None, file: Path, cancelled: IsCancelled) -> None:
        self.stage, self.scene, self.bake, self.file, self.cancelled = stage, scene, bake, file, cancelled
        self.notes: list[str] = []
        self.pictures: dict[Path, bytes] = {}
        self.names: set[str] = set()
        self.particles, why = prepared_particles(scene)
        if why:
            self.notes.append(f"no particles are written, since this scene cannot be baked as it is: {why}")
        ground = scene.model.ground
        self.ground = (
            SurfaceContact() if ground is None else
            SurfaceContact(
                friction=ground.friction, static_friction=ground.static_friction, restitution=ground.restitution
            )
        )  # fmt: skip

    def write(self) -> None:
        """Fill the stage."""
        from pxr import Gf, UsdPhysics

        model = self.scene.model
        physics = UsdPhysics.Scene.Define(self.stage, "/World/physicsScene")
        size = float(np.linalg.norm(model.gravity))
        down = np.array(model.gravity) / size if size > 0 else np.array([0.0, 0.0, -1.0])
        physics.CreateGravityDirectionAttr(Gf.Vec3f(*map(float, down)))
        physics.CreateGravityMagnitudeAttr(size)
        if self.particles is not None:
            write_scene(physics.GetPrim(), self.particles)
        if model.ground is not None:
            self._ground(model.ground.point, model.ground.normal)
        self._camera()
        baked = {item.name: item for item in self.bake.manifest.objects} if self.bake else {}
        for index, item in enumerate(model.objects):
            self._object(index, item, baked.get(item.name))
        kinds = {"named contacts": model.contacts, "effects": model.effects, "keyed gravity": model.gravity_track}
        missing = [kind for kind, there in kinds.items() if there]
        if missing:
            self.notes.append(f"USD Physics has no {', '.join(missing)}: left out")

    def _name(self, name: str) -> str:
        found = base = prim_name(name)
        number = 1
        while found in self.names or found in ("physicsScene", "ground", "camera", "Materials"):
            number += 1
            found = f"{base}_{number}"
        self.names.add(found)
        return found

    def _place(self, prim: Any, matrix: Array) -> tuple[Any, Any]:
        """Set the pose (4, 4) of ``prim``; return its operations for translation and orientation."""
        from pxr import Gf, UsdGeom

        xform = UsdGeom.Xformable(prim)
        moved, turned = xform.AddTranslateOp(), xform.AddOrientOp(UsdGeom.XformOp.PrecisionDouble)
        moved.Set(Gf.Vec3d(*map(float, matrix[:3, 3])))
        turned.Set(quaternion(matrix[:3, :3]))
        return moved, turned

    def _ground(self, point: Sequence[float], normal: Sequence[float]) -> None:
        from pxr import UsdGeom, UsdPhysics

        up = np.array(normal) / np.linalg.norm(normal)
        along = np.cross(up, [0.0, 1.0, 0.0] if abs(up[1]) < 0.9 else [1.0, 0.0, 0.0])
        along /= np.linalg.norm(along)
        matrix = np.eye(4)
        matrix[:3, :3] = np.column_stack([along, np.cross(up, along), up])
        matrix[:3, 3] = point
        plane = UsdGeom.Plane.Define(self.stage, "/World/ground")
        plane.CreateAxisAttr(UsdGeom.Tokens.z)
        plane.CreateWidthAttr(20.0)
        plane.CreateLengthAttr(20.0)
        # It holds what falls; the photo shows it.
        plane.CreatePurposeAttr(UsdGeom.Tokens.guide)
        self._place(plane, matrix)
        UsdPhysics.CollisionAPI.Apply(plane.GetPrim())
        self._bind(plane.GetPrim(), self._material("ground", self.ground, None, None))

    def _camera(self) -> None:
        from pxr import Gf, UsdGeom

        camera = self.scene.model.camera
        found = UsdGeom.Camera.Define(self.stage, "/World/camera")
        found.CreateFocalLengthAttr(FOCAL_LENGTH)
        found.CreateHorizontalApertureAttr(FOCAL_LENGTH * camera.width / camera.fx)
        found.CreateVerticalApertureAttr(FOCAL_LENGTH * camera.height / camera.fy)
        found.CreateHorizontalApertureOffsetAttr(FOCAL_LENGTH * (camera.width / 2 - camera.cx) / camera.fx)
        found.CreateVerticalApertureOffsetAttr(FOCAL_LENGTH * (camera.cy - camera.height / 2) / camera.fy)
        found.CreateClippingRangeAttr(Gf.Vec2f(0.001, 10_000.0))
        # USD looks along -z with y up, the scene's camera along z with y down.
        self._place(found, np.asarray(camera.world_from_camera) @ np.diag([1.0, -1.0, -1.0, 1.0]))

    def _object(self, index: int, item: SceneObject, baked: BakedObject | None) -> None:
        from pxr import Gf, UsdGeom, UsdPhysics

        mesh = evenly_lit_mesh(self.scene, item)
        matrix = np.asarray(item.world_from_mesh, dtype=np.float64)
        world = mesh.vertices @ matrix[:3, :3].T + matrix[:3, 3]
        faces = mesh.faces[:, ::-1] if np.linalg.det(matrix[:3, :3]) < 0 else mesh.faces
        rigid = item.role == "dynamic" and item.material.law == "rigid"
        mass = self._mass(item, world, faces) if item.role == "dynamic" else None
        centre = mass.centre if rigid and mass is not None else np.zeros(3)
        name = self._name(item.name)
        body = UsdGeom.Xform.Define(self.stage, f"/World/{name}")
        pose = np.eye(4)
        pose[:3, 3] = centre
        operations = self._place(body, pose)
        shape = self._mesh(f"/World/{name}/mesh", mesh, world - centre, faces)
        if rigid or item.role == "collider":
            UsdPhysics.CollisionAPI.Apply(shape)
            exact = UsdPhysics.Tokens.none if item.role == "collider" else UsdPhysics.Tokens.convexDecomposition
            UsdPhysics.MeshCollisionAPI.Apply(shape).CreateApproximationAttr(exact)
        prim = body.GetPrim()
        if rigid or item.motion is not None:
            api = UsdPhysics.RigidBodyAPI.Apply(prim)
            api.CreateKinematicEnabledAttr(not rigid)
            if rigid:
                api.CreateVelocityAttr(Gf.Vec3f(*map(float, item.velocity)))
                # Degrees a second, as UsdPhysics has it.
                api.CreateAngularVelocityAttr(Gf.Vec3f(*(math.degrees(v) for v in item.spin)))
                api.CreateStartsAsleepAttr(bool(item.asleep))
        if mass is not None:
            api = UsdPhysics.MassAPI.Apply(prim)
            api.CreateMassAttr(mass.mass)
            api.CreateCenterOfMassAttr(Gf.Vec3f(*map(float, mass.centre - centre)))
            api.CreateDiagonalInertiaAttr(Gf.Vec3f(*map(float, mass.inertia)))
            api.CreatePrincipalAxesAttr(Gf.Quatf(quaternion(mass.axes)))
        material = self._material(name, surface(item, self.ground), item, mesh)
        self._bind(shape, material)
        if not rigid:
            self._matter(index, name, item, material)
        if self.bake is not None and baked is not None:
            placed = UsdObject(f"/World/{name}", shape, world, centre, operations)
            self.notes += UsdMotion(self.bake, baked, matrix, self.cancelled).write(self.stage, placed, rigid=rigid)

    def _mass(self, item: SceneObject, world: Array, faces: NDArray[np.int64]) -> Mass:
        """Mass of ``item``, whose mesh has the vertices ``world`` (V, 3) in world metres."""
        thickness = None if item.fill else item.shell_thickness
        if not item.fill and thickness is None:
            self.notes.append(f"{item.name} is hollow without a shell_thickness: its mass is that of a full one")
        return mass_of(item, world, faces, thickness=thickness)

    def _matter(self, index: int, name: str, item: SceneObject, bound: Any) -> None:
        """Write what UsdPhysics has no schema for: as custom data, and as particles of Newton's schema."""
        prim, material = self.stage.GetPrimAtPath(f"/World/{name}"), item.material
        prim.SetCustomDataByKey("physgen:law", material.law)
        for field in ("density", "youngs_modulus", "poisson_ratio"):
            prim.SetCustomDataByKey(f"physgen:{field}", float(getattr(material, field)))
        if item.role != "dynamic" or self.particles is None:
            return
        body = self.particles.body_of_object[index]
        assert body is not None
        path = f"/World/{name}/matter"
        write_particles(self.stage, path, self.particles.setup.bodies[body], material, bound.GetPrim())
        self._bind(self.stage.GetPrimAtPath(path), bound)
        if not is_whole(material):
            self.notes.append(f"the law of {item.name} ({material.law}) is written in part: elasticity or viscosity")

    def _mesh(self, path: str, mesh: TexturedMesh, points: Array, faces: NDArray[np.int64]) -> Any:
        from pxr import Sdf, UsdGeom, Vt

        made = UsdGeom.Mesh.Define(self.stage, path)
        made.CreatePointsAttr(vectors(points))
        made.CreateFaceVertexCountsAttr(Vt.IntArray.FromNumpy(np.full(len(faces), 3, np.int32)))
        made.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(np.ascontiguousarray(faces, np.int32).ravel()))
        made.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
        made.CreateExtentAttr(extent(points))
        values = UsdGeom.PrimvarsAPI(made)
        if mesh.uv is not None:
            kind = Sdf.ValueTypeNames.TexCoord2fArray
            found = Vt.Vec2fArray.FromNumpy(np.ascontiguousarray(mesh.uv, np.float32))
            values.CreatePrimvar("st", kind, UsdGeom.Tokens.vertex).Set(found)
        if mesh.colours is not None:
            made.CreateDisplayColorPrimvar(UsdGeom.Tokens.vertex).Set(vectors(mesh.colours))
        return made.GetPrim()

    def _material(self, name: str, contact: SurfaceContact, item: SceneObject | None, mesh: TexturedMesh | None) -> Any:
        from pxr import Sdf, UsdPhysics, UsdShade

        path = f"/World/Materials/{name}"
        made = UsdShade.Material.Define(self.stage, path)
        api = UsdPhysics.MaterialAPI.Apply(made.GetPrim())
        api.CreateDynamicFrictionAttr(contact.friction)
        api.CreateStaticFrictionAttr(contact.sticking)
        api.CreateRestitutionAttr(contact.restitution)
        if item is None or mesh is None:
            return made
        api.CreateDensityAttr(item.material.density)
        shader = UsdShade.Shader.Define(self.stage, f"{path}/surface")
        shader.CreateIdAttr("UsdPreviewSurface")
        shader.CreateInput("roughness", Sdf.ValueTypeNames.Float).Set(0.6)
        made.CreateSurfaceOutput().ConnectToSource(shader.ConnectableAPI(), "surface")
        ending = next((end for head, end in PICTURES.items() if (mesh.picture or b"").startswith(head)), None)
        if mesh.picture is None or mesh.uv is None or ending is None:
            return made
        folder = f"{self.file.stem}_textures"
        self.pictures[self.file.parent / folder / f"{name}{ending}"] = mesh.picture
        reader = UsdShade.Shader.Define(self.stage, f"{path}/coordinates")
        reader.CreateIdAttr("UsdPrimvarReader_float2")
        reader.CreateInput("varname", Sdf.ValueTypeNames.String).Set("st")
        texture = UsdShade.Shader.Define(self.stage, f"{path}/texture")
        texture.CreateIdAttr("UsdUVTexture")
        texture.CreateInput("file", Sdf.ValueTypeNames.Asset).Set(f"./{folder}/{name}{ending}")
        texture.CreateInput("sourceColorSpace", Sdf.ValueTypeNames.Token).Set("sRGB")
        found = reader.CreateOutput("result", Sdf.ValueTypeNames.Float2)
        texture.CreateInput("st", Sdf.ValueTypeNames.Float2).ConnectToSource(found)
        colour = texture.CreateOutput("rgb", Sdf.ValueTypeNames.Float3)
        shader.CreateInput("diffuseColor", Sdf.ValueTypeNames.Color3f).ConnectToSource(colour)
        return made

    def _bind(self, prim: Any, material: Any) -> None:
        from pxr import UsdShade

        api = UsdShade.MaterialBindingAPI.Apply(prim)
        api.Bind(material)
        api.Bind(material, UsdShade.Tokens.weakerThanDescendants, "physics")


def require_scene(folder: Path) -> None:
    """Raise InputError with the way out where ``folder`` is a bake, not a scene."""
    if not is_file(folder / SCENE_FILE) and is_file(folder / "manifest.json"):
        raise InputError(f"{folder}: is a bake: give its scene, and the bake with --bake")
