# SPDX-License-Identifier: GPL-3.0-or-later
"""One throw, recorded three times, becomes three captures: a C3D file, an MCAP file, and a bag of ROS 2.

    python examples/recordings_to_captures.py work

It writes the recordings itself, with the libraries that read them: pip install 'physgen[recordings]'.
"""

from __future__ import annotations

import sys
from pathlib import Path

import ezc3d
import numpy as np
import physgen
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

TIMES = np.arange(60) / 100.0
WAY = np.array([0.0, 0.0, 1.0]) + np.outer(TIMES, [2.0, 0.0, 3.0]) + np.outer(-4.905 * TIMES**2, [0, 0, 1])


def write_c3d(path: Path) -> None:
    """Write the throw as one marker, in millimetres, with a frame in which it is occluded."""
    made = ezc3d.c3d()
    point = made["parameters"]["POINT"]
    point["LABELS"]["value"], point["UNITS"]["value"], point["RATE"]["value"] = ["ball"], ["mm"], [100.0]
    marker = np.vstack([1000 * WAY.T, np.ones(len(TIMES))])[:, None]
    residuals = np.zeros((1, 1, len(TIMES)))
    residuals[..., 20] = -1
    made["data"]["points"] = marker
    made["data"]["meta_points"]["residuals"] = residuals
    made["data"]["meta_points"]["camera_masks"] = np.zeros((7, 1, len(TIMES)), dtype=bool)
    made.write(str(path))


def write_bag(folder: Path, storage: StoragePlugin) -> None:
    """Write the throw as the topic /ball of a bag, in metres."""
    store = get_typestore(Stores.ROS2_JAZZY)
    types, kind = store.types, "geometry_msgs/msg/PointStamped"
    with Writer(folder, version=9, storage_plugin=storage) as writer:
        topic = writer.add_connection("/ball", kind, typestore=store)
        for time, (x, y, z) in zip(TIMES, WAY, strict=True):
            stamp_ns = 1_700_000_000_000_000_000 + round(time * 1e9)
            stamp = types["builtin_interfaces/msg/Time"](sec=stamp_ns // 10**9, nanosec=stamp_ns % 10**9)
            header = types["std_msgs/msg/Header"](stamp=stamp, frame_id="map")
            message = types[kind](header=header, point=types["geometry_msgs/msg/Point"](x=x, y=y, z=z))
            writer.write(topic, stamp_ns, store.serialize_cdr(message, kind))


def main(work: Path) -> list[physgen.Capture]:
    """Return the three captures."""
    work.mkdir(parents=True, exist_ok=True)
    write_c3d(work / "throw.c3d")
    write_bag(work / "mcap", StoragePlugin.MCAP)
    write_bag(work / "sqlite", StoragePlugin.SQLITE3)
    ball = physgen.ImportRequest(diameter=0.04, mass=0.0027, name="ball")
    recordings = {"c3d": work / "throw.c3d", "mcap": work / "mcap" / "mcap.mcap", "bag": work / "sqlite"}
    found = []
    for name, path in recordings.items():
        found.append(physgen.import_capture([path], ball, out=work / f"capture_{name}"))
        trial = found[-1].trials[0]
        print(f"{path.name}: {len(trial.times)} times, {trial.times[-1]:.2f} s, noise {found[-1].noise_sigma:.1e} m")
    return found


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "work"))
