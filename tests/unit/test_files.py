# SPDX-License-Identifier: GPL-3.0-or-later
"""What is refused before it is read: pipes, devices, links out of a folder, files and numbers beyond all bounds."""

import json
import os
import signal
import stat
from pathlib import Path

import cv2
import numpy as np
import pytest
import trimesh
from physgen.batch.cli import main
from physgen.sim.cache.bake_folder import disk_usage, load_bake
from physgen.sim.cache.pc2 import Pc2Reader
from physgen.sim.diagnose.track import initial_pose
from physgen.sim.diagnose.track.video_file import Video
from physgen.sim.errors import InputError
from physgen.sim.files import VIDEO_VARIABLE, name_for_ffmpeg, open_file, read_bytes, read_text, read_toml
from physgen.sim.html import page_head, require_harmless
from physgen.sim.npz import read_npy, read_npz
from physgen.sim.scene.folder import load_scene
from physgen.sim.scene.meshes import read_mesh
from physgen.sim.validation import MOST_WHOLE, parse, read_json
from PIL import EpsImagePlugin, Image

POSTSCRIPT = b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 8 8\n%%EndComments\nshowpage\n"


def textured_box(suffix, folder, picture):
    """A box in ``folder`` whose texture is ``picture``: in the GLB itself, or beside an OBJ; its file."""
    box = trimesh.creation.box((0.1, 0.1, 0.1))
    paint = trimesh.visual.material.PBRMaterial(baseColorTexture=Image.effect_noise((32, 32), 90).convert("RGB"))
    box.visual = trimesh.visual.TextureVisuals(uv=box.vertices[:, :2], material=paint)
    path = folder / f"box{suffix}"
    box.export(path)
    if suffix == ".obj":
        (texture,) = folder.glob("*.png")
        texture.write_bytes(picture)
        return path
    content = path.read_bytes()
    first, last = content.find(b"\x89PNG"), content.find(b"IEND") + 8
    assert first > 0 and len(picture) <= last - first
    path.write_bytes(content[:first] + picture.ljust(last - first) + content[last:])
    return path


@pytest.mark.skipif(os.name == "nt", reason="a program that is a script")
@pytest.mark.parametrize("suffix", [".glb", ".obj"])
def test_a_texture_in_postscript_starts_no_program(tmp_path, monkeypatch, suffix):
    """Pillow starts Ghostscript for pictures that begin so; trimesh lets it decode whatever a mesh has."""
    ran = tmp_path / "ran"
    program = tmp_path / "bin" / "gs"
    program.parent.mkdir()
    program.write_text(f"#!/bin/sh\necho yes >> {ran}\n")
    program.chmod(0o755)
    monkeypatch.setenv("PATH", f"{program.parent}{os.pathsep}{os.environ['PATH']}")
    monkeypatch.setattr(EpsImagePlugin, "gs_binary", None)
    (tmp_path / "mesh").mkdir()
    path = textured_box(suffix, tmp_path / "mesh", POSTSCRIPT)
    with pytest.raises(InputError, match="box"):
        np.asarray(read_mesh(path).visual.material.to_color(np.zeros((1, 2))))
    assert not ran.exists()
    # It is Pillow as before for everybody else in this process, such as another add-on.
    assert EpsImagePlugin.gs_binary is None and EpsImagePlugin.has_ghostscript() and ran.exists()


@pytest.fixture(autouse=True)
def within_seconds():
    """No file may keep a test waiting."""
    signal.signal(signal.SIGALRM, signal.default_int_handler)
    signal.alarm(60)
    yield
    signal.alarm(0)


def a_pipe(path):
    os.mkfifo(path)


def endless(path):
    path.symlink_to("/dev/zero")


def a_circle(path):
    path.symlink_to(path.name)


def too_long(path):
    with path.open("wb") as file:
        file.truncate(2**40)


WRONG = {"a pipe": a_pipe, "a device": endless, "a folder": lambda path: path.mkdir(), "Too many levels": a_circle}


@pytest.mark.parametrize("words", WRONG)
def test_only_regular_files_are_read(tmp_path, words):
    path = tmp_path / "scene.json"
    WRONG[words](path)
    for read in (lambda: read_bytes(path, 100), lambda: read_json(path), lambda: read_toml(path, 100)):
        with pytest.raises(InputError, match=words):
            read()


def test_a_file_is_read_to_its_bound(tmp_path):
    path = tmp_path / "x"
    path.write_bytes(b"x" * 1000)
    assert read_bytes(path, 1000) == b"x" * 1000
    with pytest.raises(InputError, match="larger than 999 bytes, so it is no job"):
        read_bytes(path, 999, what="job")
    too_long(path)
    with pytest.raises(InputError, match="larger than 16 MiB"):
        read_json(path)


def test_files_that_say_they_are_empty_are_bounded_too():
    # /proc gives no lengths.
    with pytest.raises(InputError, match="larger than 10 bytes"):
        read_bytes(Path("/proc/self/status"), 10)


def test_a_missing_file_is_left_to_the_caller(tmp_path):
    with pytest.raises(FileNotFoundError):
        open_file(tmp_path / "none", 10)


def test_links_lead_out_of_no_folder(tmp_path):
    inner = tmp_path / "scene"
    inner.mkdir()
    (tmp_path / "outside.json").write_text("{}")
    (inner / "a.json").symlink_to("../outside.json")
    (inner / "b.json").symlink_to("c.json")
    (inner / "c.json").write_text("{}")
    with pytest.raises(InputError, match="leads out of"):
        read_json(inner / "a.json", folder=inner)
    assert read_json(inner / "b.json", folder=inner) == {}


@pytest.mark.parametrize("name", ["x" * 300, "a\0b", "\ud800"])
def test_names_that_no_file_has(tmp_path, name):
    with pytest.raises((InputError, FileNotFoundError)) as refusal:
        read_text(tmp_path / name, 10)
    assert len(str(refusal.value)) < 600


def scene_json(ball_scene, **changes):
    scene = ball_scene()
    path = scene.root / "scene.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), **changes}))
    return scene.root


def test_a_name_of_70000_characters_is_refused_shortly(ball_scene):
    root = scene_json(ball_scene, photo="x" * 70_000)
    with pytest.raises(InputError, match="too long") as refusal:
        load_scene(root)
    assert len(str(refusal.value)) < 600


def test_a_folder_that_cannot_be_entered_is_named(ball_scene, monkeypatch):
    root = ball_scene().root
    real = os.stat

    def denied(path, *arguments, **options):
        if "meshes" in os.fspath(path):
            raise PermissionError(13, "Permission denied", os.fspath(path))
        return real(path, *arguments, **options)

    # As for anybody but root, whom permissions do not stop.
    monkeypatch.setattr(os, "stat", denied)
    with pytest.raises(InputError, match=r"meshes/ball0\.glb.*missing or cannot be read"):
        load_scene(root)


MANIFEST = {
    "format": "physgen-bake/1",
    "inputs_hash": "0",
    "fps": 24.0,
    "frame_start": 1,
    "frames": 3,
    "frames_done": 3,
    "state": "complete",
    "engine": "mpm",
    "version": "0",
    "particles": 1,
    "objects": [
        {"name": "a", "file": "a.pc2", "vertices": 8, "splats_file": "b.pc2", "splats_folder": "s", "splats": 1}
    ],
}


@pytest.mark.parametrize(
    "change",
    [
        {"frames": 10**9},
        {"frames": 10**9, "frames_done": 10**9},
        {"frames": 10**30},
        {"frame_start": 10**18},
        {"fps": 1e300},
        {"fps": 10**400},
        {"objects": MANIFEST["objects"] * 20_000},
        {"objects": [{"name": "a", "file": "a.pc2", "vertices": 2**40}]},
    ],
    ids=lambda change: str(change)[:40],
)
def test_a_manifest_cannot_claim_what_no_bake_has(tmp_path, change):
    frames = {"frames": 100_000} if "objects" in change else {}
    (tmp_path / "manifest.json").write_text(json.dumps({**MANIFEST, **frames, **change}))
    for use in (load_bake, disk_usage):
        with pytest.raises(InputError):
            use(tmp_path)


def test_whole_numbers_are_bounded():
    from physgen.sim.app.bake_options import BakeOptions

    assert parse(BakeOptions, {"seed": MOST_WHOLE}, "job").seed == MOST_WHOLE
    for seed in (MOST_WHOLE + 1, 10**4000, 10**5000):
        with pytest.raises(InputError, match=r"job\.seed: expected a whole number"):
            parse(BakeOptions, {"seed": seed}, "job")


def npy(path, header):
    head = header.encode()
    head += b" " * (-(10 + len(head) + 1) % 64) + b"\n"
    path.write_bytes(b"\x93NUMPY\x01\x00" + len(head).to_bytes(2, "little") + head + bytes(64))
    return path


@pytest.mark.parametrize(
    "header",
    [
        '" 64), }"',
        "{'descr': '<f8', 'fortran_order': False, 'shape': (8, 64), }\"",
        "{'descr': '<f8', 'fortran_order': False, 'shape': (8,",
        "{'descr': '<f8', 'fortran_order': False, 'shape': (" + "9" * 300 + ",), }",
        "{'descr': '<f8', 'fortran_order': False, 'shape': (0, " + "9" * 30 + "), }",
        "{'descr': '<f8', 'fortran_order': False, 'shape': (-8,), }",
        "{'descr': '|O', 'fortran_order': False, 'shape': (8,), }",
        "{'descr': '<f8', 'fortran_order': False, 'shape': (True, 8), }",
        "[" * 5000,
    ],
    ids=lambda header: header[-30:],
)
def test_no_header_of_an_array_gets_further(tmp_path, header):
    with pytest.raises(InputError):
        read_npy(npy(tmp_path / "x.npy", header), 2**20)


def test_an_archive_whose_member_is_longer_than_it_says(tmp_path):
    np.savez(tmp_path / "x.npz", a=np.arange(4.0))
    whole = bytearray((tmp_path / "x.npz").read_bytes())
    at = whole.index(b"'shape': (4,)")
    whole[at : at + 13] = b"'shape': (2,)"
    (tmp_path / "x.npz").write_bytes(whole)
    with pytest.raises(InputError):
        read_npz(tmp_path / "x.npz", 2**20)


def test_a_cache_that_is_a_pipe_is_refused(tmp_path):
    os.mkfifo(tmp_path / "a.pc2")
    with pytest.raises(InputError, match="a pipe"):
        Pc2Reader(tmp_path / "a.pc2")


@pytest.mark.parametrize("command", ["bake", "variant", "free", "estimate"])
def test_an_output_of_300_characters_is_one_line(ball_scene, tmp_path, capfd, command):
    scene = ball_scene().root
    place = str(tmp_path / ("x" * 300))
    arguments = {
        "bake": ["bake", str(scene), "--out", place, "--frames", "2"],
        "variant": ["variant", str(scene), "--out", place],
        "free": ["free", place],
        "estimate": ["estimate", place],
    }[command]
    assert main(arguments) == 3
    said = capfd.readouterr().err
    assert "Traceback" not in said and len(said.strip().splitlines()) == 1 and len(said) < 1500


# Whatever the installed trimesh itself would open, meshes see their own folder only.


def an_obj(folder, names, picture):
    rows = "".join(f"v {x} {y} {z}\n" for x, y, z in trimesh.creation.box().vertices)
    faces = "".join(f"f {a}/1 {b}/2 {c}/3\n" for a, b, c in trimesh.creation.box().faces + 1)
    (folder / "a.obj").write_text(f"mtllib {names}\n{rows}vt 0 0\nvt 1 0\nvt 0 1\nusemtl m\n{faces}")
    (folder / "a.mtl").write_text(f"newmtl m\nKd 1 1 1\nmap_Kd {picture}\n")


@pytest.mark.parametrize("inside", [True, False])
def test_a_mesh_opens_no_file_outside_its_folder(tmp_path, monkeypatch, inside):
    from PIL import Image

    folder = tmp_path / "meshes"
    folder.mkdir()
    Image.fromarray(np.full((4, 4, 3), 200, np.uint8)).save((folder if inside else tmp_path) / "p.png")
    an_obj(folder, "a.mtl", "p.png" if inside else "../p.png")
    (tmp_path / "b.mtl").write_text("newmtl m\nmap_Kd p.png\n")
    opened = []
    real = os.open
    monkeypatch.setattr(os, "open", lambda path, *rest, **more: opened.append(str(path)) or real(path, *rest, **more))
    mesh = read_mesh(folder / "a.obj")
    assert (mesh.visual.material.image is not None) == inside
    an_obj(folder, "../b.mtl", "p.png")
    read_mesh(folder / "a.obj")
    assert opened and all(path.startswith(str(folder)) for path in opened)


def test_a_gltf_reads_no_buffer_outside_its_folder(tmp_path):
    folder = tmp_path / "meshes"
    folder.mkdir()
    for name, content in trimesh.exchange.gltf.export_gltf(trimesh.Scene(trimesh.creation.box())).items():
        (folder / ("a.gltf" if name.endswith(".gltf") else name)).write_bytes(content)
    assert len(read_mesh(folder / "a.gltf").faces) == 12
    document = json.loads((folder / "a.gltf").read_text())
    buffer = document["buffers"][0]["uri"]
    (folder / buffer).rename(tmp_path / buffer)
    for uri in (f"../{buffer}", str(tmp_path / buffer), f"%2e%2e/{buffer}"):
        document["buffers"][0]["uri"] = uri
        (folder / "a.gltf").write_text(json.dumps(document))
        with pytest.raises(InputError):
            read_mesh(folder / "a.gltf")
    assert stat.S_ISREG((tmp_path / buffer).stat().st_mode)


@pytest.mark.parametrize(
    ("page", "good"),
    [
        ('<!DOCTYPE html>\n<html lang="en">{head}\n<body><p>a</p><script>alert(1)</script></body></html>', True),
        ('<script>alert(1)</script><!DOCTYPE html>\n<html lang="en">{head}<body></body></html>', False),
        ('<!DOCTYPE html>\n<html lang="en" onload="alert(1)">{head}<body></body></html>', False),
        ('<!DOCTYPE html>\n<html lang="en">{runs}<body></body></html>', False),
        ("<!DOCTYPE html>\n<html lang=\"en\">{head}<META HTTP-EQUIV=refresh content='0;url=//evil'></html>", False),
        ('<!DOCTYPE html>\n<html lang="en">{head}<LINK rel="preconnect" href="https://evil"></html>', False),
        ("<html><body>a</body></html>", False),
        ("", False),
    ],
)
def test_only_a_page_that_the_browser_holds_to_our_policy_is_opened(tmp_path, page, good):
    """A browser runs no script after the policy; a page with one before it, or that leads elsewhere, is not shown."""
    text = page.format(head=page_head("t", "p{}"), runs=page_head("t", "p{}", script="alert(1)"))
    (tmp_path / "report.html").write_text(text, encoding="utf-8")
    if good:
        require_harmless(tmp_path / "report.html")
        return
    with pytest.raises(InputError, match="may run scripts, so it is not opened"):
        require_harmless(tmp_path / "report.html")


def test_every_page_that_is_written_forbids_scripts_or_names_its_own():
    """Templates take their head from ``page_head``, which has the policy, or bring a policy themselves."""
    root = Path(__file__).resolve().parents[2]
    templates = [path for part in ("sim", "batch", "blind_check") for path in (root / part).rglob("*.html")]
    assert len(templates) >= 5
    for path in templates:
        text = path.read_text(encoding="utf-8")
        assert "{{ head }}" in text or "default-src 'none'" in text or "<head" not in text, path


def short_video(path):
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"MJPG"), 24, (64, 48))
    for level in range(3):
        writer.write(np.full((48, 64, 3), 90 * level, np.uint8))
    writer.release()


@pytest.mark.parametrize("name", ["a.mp4", "a.m3u8", "a.ffconcat"])
@pytest.mark.parametrize("kind", ["ffconcat version 1.0\nfile 'real.avi'\n", "#EXTM3U\n#EXTINF:1.0,\n{real}\n"])
def test_a_playlist_is_no_video_whatever_it_is_called(tmp_path, name, kind):
    """FFmpeg would read the files that it names, wherever they are."""
    short_video(tmp_path / "real.avi")
    (tmp_path / name).write_text(kind.format(real=(tmp_path / "real.avi").as_uri()))
    with pytest.raises(InputError, match="not a readable video"):
        Video(tmp_path / name)
    with Video(tmp_path / "real.avi") as video:
        assert len(list(video.frames(0, None))) == 3


def test_a_video_in_a_folder_called_as_a_protocol_is_that_file(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv(VIDEO_VARIABLE, "threads;1")
    for folder in (Path("http:"), Path("data:text")):
        folder.mkdir()
        short_video(folder / "a.avi")
        with Video(folder / "a.avi") as video:
            assert video.info.width == 64
    assert name_for_ffmpeg(Path("a")) == str(tmp_path / "a")
    assert os.environ[VIDEO_VARIABLE].startswith("threads;1|format_whitelist;mov,")
    assert os.environ[VIDEO_VARIABLE].count("whitelist") == 2


def test_no_name_of_a_file_forges_a_line(tmp_path):
    with pytest.raises(InputError) as refused:
        (tmp_path / "a\nerror: \x1b[2Jb").mkdir()
        read_bytes(tmp_path / "a\nerror: \x1b[2Jb", 9)
    assert str(refused.value).isprintable()


def test_a_photo_in_jpeg_2000_is_not_decoded_by_opencv(ball_scene):
    """Whatever it is called: up to 4.11 its decoder has a hole (CVE-2025-53644)."""
    scene = ball_scene()

    def write(suffix):
        done, content = cv2.imencode(suffix, np.zeros((32, 32, 3), np.uint8))
        assert done
        (scene.root / "photo.png").write_bytes(content.tobytes())

    for suffix in (".png", ".jpg", ".bmp", ".webp", ".tiff"):
        write(suffix)
        assert initial_pose._picture(scene, "photo.png", (32, 32)).shape == (32, 32)
    write(".jp2")
    with pytest.raises(InputError, match="is not an image that can be read"):
        initial_pose._picture(scene, "photo.png", (32, 32))
