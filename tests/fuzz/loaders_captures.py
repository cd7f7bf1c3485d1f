# SPDX-License-Identifier: MIT
"""Captures, diagnoses, fits."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
from loaders import BOX, POSE, add, put_json, put_scene, put_video, text_of
from physgen.blind_check.fit_records import FORMAT as FIT_RECORD
from physgen.blind_check.fit_records import load_records
from physgen.sim.app.add_effect import found_effects, with_effects
from physgen.sim.app.import_capture import ImportRequest, import_capture
from physgen.sim.diagnose.capture import Camera as CaptureCamera
from physgen.sim.diagnose.capture import Capture, CaptureObject, Ground, ObjectBelief, Trial
from physgen.sim.diagnose.capture_folder import load_capture, save_capture
from physgen.sim.diagnose.diagnosis import read_diagnosis
from physgen.sim.diagnose.track.plain_bodies import follow_plain_body
from physgen.sim.diagnose.track.track_input import VideoTrial, parse_body
from physgen.sim.importers.recordings import read_recording
from physgen.sim.scene.folder import load_scene


def _capture(folder: Path, *, pixels: bool = False) -> None:
    times = 0.1 + 0.01 * np.arange(12)
    rest = np.asarray(BOX.vertices) * 0.9
    points = np.stack([0.5 * times, 0 * times, 1 + 2 * times], axis=1)[:, None] + rest
    trial = Trial(
        name="t",
        role="fit",
        times=times,
        points=None if pixels else points,
        pixels=points[..., :2] if pixels else None,
        object_index=np.zeros(8, np.int64),
        rest_points=rest,
    )
    belief = ObjectBelief(name="body", mesh="body.obj", density_kg_m3=400.0, stiffness="hard")
    item = CaptureObject(belief=belief, vertices=np.asarray(BOX.vertices), faces=np.asarray(BOX.faces))
    camera = CaptureCamera(width=64, height=48, fx=50.0, fy=50.0, cx=32.0, cy=24.0, world_from_camera=POSE)
    made = Capture(
        gravity=(0.0, 0.0, -9.81),
        ground=Ground(friction=0.4, restitution=0.3),
        objects=(item,),
        noise_sigma=0.0005,
        camera=camera if pixels else None,
        trials=(trial,),
    )
    save_capture(made, folder / "c")


WIND = {
    name: {"value": value}
    for name, value in (("wind_x", 2.0), ("wind_y", 0.0), ("wind_z", 0.0), ("drag_per_mass", 0.5))
}


def _diagnosis(folder: Path) -> None:
    effect = {
        "name": "wind",
        "kind": "force",
        "probability": 0.9,
        "parameters": WIND,
    }
    report = {
        "format": "physgen-diagnosis/1",
        "verdict": {"effect": "wind", "probability": 0.9, "alternatives": [], "effects": ["wind"]},
        "effects": [effect],
        "gap": {},
        "where": {},
    }
    put_json(folder / "report.json", report)
    for name in ("where", "prediction"):
        np.savez(folder / f"{name}.npz", **{"t.times": np.arange(4.0), "t.found": np.zeros((4, 8, 3))})
    (folder / "scene").mkdir(exist_ok=True)
    put_scene(folder / "scene")


def _read_diagnosis(folder: Path) -> None:
    report, _, _ = read_diagnosis(folder)
    with_effects(load_scene(folder / "scene").model, found_effects(report))


add("capture", ("c/capture.json", "c/t.npz", "c/body.obj"), _capture, lambda f: load_capture(f / "c"))
add(
    "capture of pixels",
    ("c/capture.json", "c/t.npz"),
    lambda f: _capture(f, pixels=True),
    lambda f: load_capture(f / "c"),
)
add("diagnosis", ("report.json", "where.npz"), _diagnosis, _read_diagnosis)


def _fit_record(folder: Path) -> None:
    fit = {"effects": ["wind"], "log_evidence": 3.0, "heldout_rms_m": 0.01, "misfit": 1.0, "heldout_log_score": [1.0]}
    fit["parameters"] = {"wind": {"wind_x": [2.0, 1.5, 2.5, "m/s"]}}
    nominal = {**fit, "effects": [], "parameters": {}}
    models = {"nominal": nominal, "refitted": nominal, "candidates": [fit], "withheld_rms_m": {"": 0.1, "wind": 0.01}}
    truth = {"effect": "wind", "effects": ["wind"], "parameters": {}}
    sizes = {"floor_rms_m": 0.001, "grain_rms_m": 0.001}
    put_json(folder / "case-0000.json", {"format": FIT_RECORD, "matter": "rigid", "truth": truth, **models, **sizes})


add("fit record", "case-0000.json", _fit_record, load_records)


# Tables of measured motion, and videos of one body


def _table(folder: Path) -> None:
    rows = [f"{0.01 * i},{0.1 * i},0.0,{1.0 - 0.02 * i * i},1,0,0,0" for i in range(12)]
    (folder / "t.csv").write_text("\n".join(["time_s,x_m,y_m,z_m,qw,qx,qy,qz", *rows]))


def _markers(folder: Path) -> None:
    rows = [f"{0.01 * i},{0.1 * i},0,1,{0.1 * i},0,1.1" for i in range(12)]
    (folder / "t.csv").write_text("\n".join(["time,a_x,a_y,a_z,b_x,b_y,b_z", *rows]))
    (folder / "rest.csv").write_text("a,0,0,-0.05\nb,0,0,0.05\n")


def _import(folder: Path) -> None:
    request = ImportRequest(diameter=0.1, density=400.0, rest=folder / "rest.csv")
    import_capture([folder / "t.csv"], request, out=folder / "capture")


def _deeplabcut(folder: Path) -> None:
    rows = [f"{i},{10 + i},{20 - i},0.9" for i in range(8)]
    head = ["scorer,net,net,net", "bodyparts,nose,nose,nose", "coords,x,y,likelihood"]
    (folder / "t.csv").write_text("\n".join([*head, *rows]))


def _tracker(folder: Path) -> None:
    steps = "".join(
        f"<property name='[{i}]' type='object'>"
        f"<object class='org.opensourcephysics.cabrillo.tracker.PointMass$FrameData'>"
        f"<property name='n' type='int'>{i}</property><property name='x' type='double'>{10 + i}</property>"
        f"<property name='y' type='double'>{20 + i}</property></object></property>"
        for i in range(5)
    )
    (folder / "t.trk").write_text(
        "<?xml version='1.0'?><object class='org.opensourcephysics.cabrillo.tracker.TrackerPanel'>"
        "<object class='org.opensourcephysics.media.core.VideoClip'/>"
        "<object class='org.opensourcephysics.media.core.ClipControl'>"
        "<property name='delta_t' type='double'>33.3</property></object>"
        "<object class='org.opensourcephysics.media.core.ImageCoordSystem'>"
        "<object class='org.opensourcephysics.media.core.ImageCoordSystem$FrameData'>"
        "<property name='xorigin' type='double'>1</property><property name='yorigin' type='double'>2</property>"
        "<property name='angle' type='double'>0</property><property name='xscale' type='double'>100</property>"
        "<property name='yscale' type='double'>100</property></object></object>"
        "<object class='org.opensourcephysics.cabrillo.tracker.PointMass'><property name='name'>ball</property>"
        f"<property name='framedata' type='array'>{steps}</property></object></object>"
    )


def _c3d(folder: Path) -> None:
    import ezc3d

    made = ezc3d.c3d()
    group = made["parameters"]["POINT"]
    group["RATE"]["value"], group["LABELS"]["value"], group["UNITS"]["value"] = [100.0], ["a", "b"], ["mm"]
    made["data"]["points"] = np.random.default_rng(0).normal(size=(4, 2, 12))
    made["data"]["meta_points"]["residuals"] = np.zeros((1, 2, 12))
    made["data"]["meta_points"]["camera_masks"] = np.zeros((7, 2, 12), dtype=bool)
    made.write(str(folder / "t.c3d"))


def _bag(folder: Path, storage: str) -> None:
    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.LATEST)
    kind = "geometry_msgs/msg/PointStamped"
    made = store.types
    with Writer(folder / "made", version=9, storage_plugin=StoragePlugin[storage]) as writer:
        connection = writer.add_connection("/ball", kind, typestore=store)
        for i in range(12):
            stamp = made["builtin_interfaces/msg/Time"](sec=5, nanosec=10_000_000 * i)
            header = made["std_msgs/msg/Header"](stamp=stamp, frame_id="map")
            point = made["geometry_msgs/msg/Point"](x=0.1 * i, y=0.0, z=1.0)
            message = made[kind](header=header, point=point)
            writer.write(connection, 10_000_000 * i, store.serialize_cdr(message, kind))
    (file,) = (p for p in (folder / "made").iterdir() if p.suffix in (".mcap", ".db3"))
    target = folder / ("t.mcap" if storage == "MCAP" else "bag/t.db3")
    target.parent.mkdir(exist_ok=True)
    file.rename(target)
    shutil.rmtree(folder / "made")


READERS_SHARE = 0.25


def _falling(folder: Path) -> None:
    rows, columns = np.mgrid[:60, :80] + 0.5
    frames = []
    for i in range(16):
        frame = np.full((60, 80, 3), 200, np.uint8)
        frame[(columns - 30 - i) ** 2 + (rows - 12 - 0.15 * i * i) ** 2 < 36] = (30, 40, 160)
        frames.append(frame)
    put_video(folder / "v.mp4", frames)


def _follow(folder: Path) -> None:
    follow_plain_body(VideoTrial(path=folder / "v.mp4", fps_override=99), parse_body("ball:diameter=0.04"))


add("table of poses", "t.csv", _table, lambda f: read_recording(f / "t.csv"))
add("table of markers", ("t.csv", "rest.csv"), _markers, _import)
add("table of DeepLabCut", "t.csv", _deeplabcut, lambda f: read_recording(f / "t.csv"))
add("C3D file", "t.c3d", _c3d, lambda f: read_recording(f / "t.c3d"), READERS_SHARE)
add("bag of ROS 2, MCAP", "t.mcap", lambda f: _bag(f, "MCAP"), lambda f: read_recording(f / "t.mcap"), READERS_SHARE)
add(
    "bag of ROS 2, SQLite",
    "bag/t.db3",
    lambda f: _bag(f, "SQLITE3"),
    lambda f: read_recording(f / "bag"),
    READERS_SHARE,
)
add("project of Tracker", "t.trk", _tracker, lambda f: read_recording(f / "t.trk"))
add(
    "body that was filmed",
    "b.txt",
    lambda f: (f / "b.txt").write_text("cylinder:diameter=0.04,height=0.01,mass=0.0027,friction=0.3,name=coin"),
    lambda f: parse_body(text_of(f / "b.txt").decode("utf-8", "replace")),
)
add("video of one body", "v.mp4", _falling, _follow)
