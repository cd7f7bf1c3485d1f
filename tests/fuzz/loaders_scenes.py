# SPDX-License-Identifier: MIT
"""Scenes, what is recorded beside them, meshes and splats."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import trimesh
from loaders import BOX, PIXELS, RANDOM, add, put_json, put_picture, put_scene, text_of
from physgen.sim.app import propose
from physgen.sim.app.bake_options import BakeOptions, inputs_hash
from physgen.sim.app.bake_samples import load_object_splats
from physgen.sim.app.import_folder import import_folder
from physgen.sim.app.reconstruct import _answered, read_stamp
from physgen.sim.app.scene_variant import _with_effects
from physgen.sim.gaussians.mesh_to_splats import Texture
from physgen.sim.gaussians.splat_ply import read_splat_file, write_splats
from physgen.sim.gaussians.splats import Splats
from physgen.sim.scene.camera_path import load_camera_path, save_camera_path, swing
from physgen.sim.scene.folder import load_scene, save_scene, side_files
from physgen.sim.scene.meshes import load_vertex_track, read_mesh
from physgen.sim.scene.overrides import apply_overrides
from physgen.sim.scene.shading import evenly_lit_mesh, factors_at, read_shading
from physgen.sim.scene.textured_mesh import read_textured_mesh, write_moved_mesh
from PIL import Image


def _read_scene(folder: Path) -> None:
    scene = load_scene(folder)
    scene.files()
    inputs_hash(scene, BakeOptions())
    apply_overrides(scene.model, ("box.density=300",))


def _physics(folder: Path) -> None:
    put_json(folder / "physics.json", {"answers": {"raw": "1. metal, 3000, hard"}, "objects": []})


def _mjcf(folder: Path) -> None:
    BOX.export(folder / "box.stl")
    (folder / "m.xml").write_text(
        "<mujoco><default><geom density='500'/></default><asset><mesh name='b' file='box.stl' scale='1 1 1'/></asset>"
        "<worldbody><geom type='plane' size='1 1 1'/><body name='a' pos='0 0 1' euler='10 20 30'><freejoint/>"
        "<geom type='capsule' fromto='0 0 0 0 0 0.1' size='0.02'/><geom type='mesh' mesh='b' quat='1 0 0 1'/>"
        "<body><joint/><geom type='cylinder' size='0.02 0.05' mass='0.1'/></body></body></worldbody></mujoco>"
    )


def _urdf(folder: Path) -> None:
    BOX.export(folder / "box.stl")
    (folder / "m.urdf").write_text(
        "<robot><link name='a'><inertial><mass value='1'/><inertia ixx='0.01' ixy='0' ixz='0' iyy='0.01' iyz='0' "
        "izz='0.01'/></inertial><collision><geometry><mesh filename='box.stl'/></geometry></collision></link>"
        "<link name='b'><collision><geometry><sphere radius='0.1'/></geometry></collision></link>"
        "<joint name='j' type='fixed'><parent link='a'/><child link='b'/><origin xyz='0 0 1' rpy='0 1 0'/>"
        "</joint></robot>"
    )


def _stamp(folder: Path) -> None:
    scene = {"format": "physgen-scene/1"}
    put_json(
        folder / "reconstruct.json",
        {
            "inputs_hash": "0" * 64,
            "photo": "photo.png",
            "objects": [{"name": "cup", "box": [1, 2, 30, 40], "velocity": [0, 0, 1]}],
            "options": {"seed": 3},
            "scene": scene,
        },
    )


def _effects_text(folder: Path) -> None:
    put_json(folder / "effects.json", [{"name": "gravity_tilt", "parameters": {"angle": 0.1, "azimuth": 0.0}}])
    put_scene(folder)


def _read_effects(folder: Path) -> None:
    text = text_of(folder / "effects.json").decode("utf-8", "replace")
    _with_effects(load_scene(folder).model, text)


add("scene", "scene.json", put_scene, _read_scene)
add("scene physics", "physics.json", _physics, _answered)
add("reconstruct record", "reconstruct.json", _stamp, read_stamp)
add("effects of a variant", "effects.json", _effects_text, _read_effects)
add(
    "camera path",
    "path.json",
    lambda f: save_camera_path(f / "path.json", swing(first=1, last=24, azimuth_deg=5.0)),
    lambda f: load_camera_path(f / "path.json"),
)


def _proposals(folder: Path) -> None:
    listed = [{"box": [1, 2, 30, 40], "score": 0.9}]
    record = propose.ProposalRecord(
        photo="photo.png",
        photo_hash="0",
        width=64,
        height=48,
        proposals=(propose.Proposal(box=(1, 2, 30, 40), score=0.9),),
    )
    put_json(folder / propose.LIST_FILE, {**propose.to_json(record), "proposals": listed})


add("proposals", propose.LIST_FILE, _proposals, lambda f: propose._earlier(f, "0", "none"))


def _glb(folder: Path) -> None:
    uv = RANDOM.random((len(BOX.vertices), 2))
    image = Image.fromarray(PIXELS[:8, :8])
    visual = trimesh.visual.TextureVisuals(uv=uv, material=trimesh.visual.material.PBRMaterial(baseColorTexture=image))
    trimesh.Trimesh(BOX.vertices, BOX.faces, visual=visual, process=False).export(folder / "box.glb")


def _read_glb(folder: Path) -> None:
    Texture.of(read_textured_mesh(folder / "box.glb"))


def _shading(folder: Path) -> None:
    put_scene(folder)
    _glb(folder)
    put_picture(folder / "shading.png", PIXELS[:8, :8])


def _read_shading(folder: Path) -> None:
    scene = load_scene(folder)
    item = dataclasses.replace(scene.objects[0], mesh="box.glb", shading="shading.png")
    evenly_lit_mesh(scene, item)
    factors_at(read_shading(scene, item), RANDOM.random((5, 2)))


def _gltf(folder: Path) -> None:
    for name, content in trimesh.exchange.gltf.export_gltf(trimesh.Scene(BOX)).items():
        (folder / ("box.gltf" if name.endswith(".gltf") else name)).write_bytes(content)


def _read_gltf(folder: Path) -> None:
    side_files(folder / "box.gltf")
    read_mesh(folder / "box.gltf")


def _obj(folder: Path) -> None:
    faces = "".join(f"f {a}/1 {b}/2 {c}/3\n" for a, b, c in BOX.faces + 1)
    rows = "".join(f"v {x} {y} {z}\n" for x, y, z in BOX.vertices)
    (folder / "box.obj").write_text(f"mtllib box.mtl\n{rows}vt 0 0\nvt 1 0\nvt 0 1\nusemtl a\n{faces}")
    (folder / "box.mtl").write_text("newmtl a\nKd 1 0.5 0\nmap_Kd box.png\n")
    put_picture(folder / "box.png", PIXELS[:8, :8])


def _read_obj(folder: Path) -> None:
    side_files(folder / "box.obj")
    read_mesh(folder / "box.obj")


def _moved(folder: Path) -> None:
    mesh = read_mesh(folder / "box.glb")
    write_moved_mesh(folder / "box.glb", folder / "moved.glb", np.asarray(mesh.vertices) + 1.0, np.asarray(mesh.faces))


def _track(folder: Path) -> None:
    np.savez(folder / "track.npz", times=np.arange(3.0), vertices=np.zeros((3, 8, 3)))


def _splats(count: int = 6) -> Splats:
    turns = np.tile((1.0, 0.0, 0.0, 0.0), (count, 1))
    return Splats(
        centres=RANDOM.random((count, 3)),
        scales=np.full((count, 3), 0.01),
        rotations=turns,
        colours=RANDOM.random((count, 3)),
        opacities=np.full(count, 0.5),
    )


def _ascii_splats(folder: Path) -> None:
    write_splats(folder / "b.ply", _splats())
    head, _, body = (folder / "b.ply").read_bytes().partition(b"end_header\n")
    rows = np.frombuffer(body, "<f4").reshape(6, -1)
    text = "\n".join(" ".join(f"{v:g}" for v in row) for row in rows)
    head = head.replace(b"binary_little_endian", b"ascii")
    (folder / "a.ply").write_bytes(head + b"end_header\n" + text.encode() + b"\n")


def _packed_splats(folder: Path) -> None:
    chunk = [f"property float {side}_{axis}" for side in ("min", "max") for axis in "xyz"]
    chunk += [f"property float {side}_scale_{axis}" for side in ("min", "max") for axis in "xyz"]
    packed = [f"property uint packed_{kind}" for kind in ("position", "rotation", "scale", "color")]
    head = [
        "ply",
        "format binary_little_endian 1.0",
        "element chunk 1",
        *chunk,
        "element vertex 5",
        *packed,
        "end_header",
        "",
    ]
    ranges = np.array([0, 0, 0, 1, 1, 1, -5, -5, -5, -4, -4, -4], "<f4")
    body = ranges.tobytes() + RANDOM.integers(0, 2**32, 20, dtype=np.uint32).astype("<u4").tobytes()
    (folder / "p.ply").write_bytes("\n".join(head).encode() + body)


def _splat_object(folder: Path) -> None:
    scene = put_scene(folder)
    write_splats(folder / "box.ply", dataclasses.replace(_splats(), centres=np.asarray(BOX.vertices)[:6]))
    item = dataclasses.replace(scene.objects[0], splats="box.ply")
    save_scene(folder, dataclasses.replace(scene.model, objects=(item,)))


def _read_splat_object(folder: Path) -> None:
    from physgen.sim.scene.meshes import load_object_mesh

    scene = load_scene(folder)
    load_object_splats(scene, scene.objects[0], load_object_mesh(scene, scene.objects[0]))


add("model of MuJoCo", ("m.xml", "box.stl"), _mjcf, lambda f: import_folder(f / "m.xml", out=f / "scene"))
add("model in URDF", ("m.urdf", "box.stl"), _urdf, lambda f: import_folder(f / "m.urdf", out=f / "scene"))
add("mesh GLB", "box.glb", _glb, _read_glb)
add("shading of a texture", "shading.png", _shading, _read_shading)
add("mesh GLB through trimesh", "box.glb", lambda f: BOX.export(f / "box.glb"), lambda f: read_mesh(f / "box.glb"))
add("mesh glTF", "box.gltf", _gltf, _read_gltf)
add("mesh OBJ", ("box.obj", "box.mtl", "box.png"), _obj, _read_obj)
add("mesh PLY", "box.ply", lambda f: BOX.export(f / "box.ply"), lambda f: read_mesh(f / "box.ply"))
add("mesh STL", "box.stl", lambda f: BOX.export(f / "box.stl"), lambda f: read_mesh(f / "box.stl"))
add("mesh moved", "box.glb", lambda f: BOX.export(f / "box.glb"), _moved)
add("vertex track", "track.npz", _track, lambda f: load_vertex_track(f / "track.npz", 8))
add("splats binary", "b.ply", lambda f: write_splats(f / "b.ply", _splats()), lambda f: read_splat_file(f / "b.ply"))
add("splats text", "a.ply", _ascii_splats, lambda f: read_splat_file(f / "a.ply"))
add("splats packed", "p.ply", _packed_splats, lambda f: read_splat_file(f / "p.ply"))
add("splats of an object", "box.ply", _splat_object, _read_splat_object)
