# SPDX-License-Identifier: MIT
"""``PYTHON recording_worker.py FILE OUT``: the points or poses in a C3D file, or in a file of a ROS 2 bag, as arrays.

A script of its own, which ``recorded_files.py`` starts under bounds on memory and time: readers of these formats are
native code or unpack what a file says, and damaged files crash them (ezc3d: 2 of 300) or fill the memory. It imports
nothing of PhysGen. Writes OUT/arrays.npz and OUT/found.json; the latter is ``{"error": …}`` for what cannot be read.
"""

from __future__ import annotations

import json
import math
import sys
from pathlib import Path
from typing import Any

MEMORY, BYTES_A_SECOND = 3 * 2**30, 2**24
SPARE_S = {".c3d": 4, ".mcap": 20, ".db3": 20}
"""Bounds: address space; CPU seconds, and bytes of the file that each further one is for. A damaged C3D file may keep
its reader busy for ever; messages of bags are read one by one, which takes long for a sound one, too."""
MOST_POSES = 2_000_000
"""Poses of a bag, over all of its topics."""
MOST_POINTS = 1024
ZSTD = b"\x28\xb5\x2f\xfd"
STAMPED = {
    "geometry_msgs/msg/PoseStamped": lambda m: m.pose,
    "geometry_msgs/msg/PoseWithCovarianceStamped": lambda m: m.pose.pose,
    "nav_msgs/msg/Odometry": lambda m: m.pose.pose,
    "geometry_msgs/msg/TransformStamped": lambda m: m.transform,
    "geometry_msgs/msg/PointStamped": lambda m: m.point,
}
"""Message type → what in it has a place, and perhaps an orientation."""
SEVERAL = ("geometry_msgs/msg/PoseArray", "tf2_msgs/msg/TFMessage")


def bound(path: Path) -> None:
    """Bound this process; on Windows only its time is bounded, by who started it."""
    try:
        import resource
    except ImportError:
        return
    _, hard = resource.getrlimit(resource.RLIMIT_AS)
    most = MEMORY if hard == resource.RLIM_INFINITY else min(MEMORY, hard)
    resource.setrlimit(resource.RLIMIT_AS, (most, hard))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    seconds = SPARE_S[path.suffix] + path.stat().st_size // BYTES_A_SECOND
    resource.setrlimit(resource.RLIMIT_CPU, (seconds, seconds + 1))


def read_c3d(path: str) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return ({``points`` (T, K, 3), NaN where occluded}, {labels, unit, rate, first, up, residual, occluded})."""
    import ezc3d
    import numpy as np

    data = ezc3d.c3d(path)
    group = data["parameters"].get("POINT", {})

    def text(name: str) -> list[str]:
        # Names beyond the 255th are in LABELS2, LABELS3 …
        found: list[str] = []
        for number in ("", *range(2, 10)):
            value = group.get(f"{name}{number}", {}).get("value", [])
            found += [str(entry) for entry in value] if isinstance(value, list) else []
        return found

    points = np.asarray(data["data"]["points"], dtype=np.float64)[:3].transpose(2, 1, 0)
    residuals = np.asarray(data["data"]["meta_points"]["residuals"], dtype=np.float64)
    # (1, K, T); -1 is "not seen". Some programs write zeros instead of it.
    hidden = np.zeros(points.shape[:2], dtype=bool)
    if residuals.shape[1:] == points.shape[1::-1]:
        hidden = residuals[0].T < 0
        seen = residuals[0].T[~hidden & (residuals[0].T > 0)]
    else:
        seen = residuals[:0]
    hidden |= (points == 0).all(axis=2) | ~np.isfinite(points).all(axis=2)
    points = np.where(hidden[..., None], np.nan, points)
    labels = text("LABELS")[: points.shape[1]]
    labels += [f"point{i + 1}" for i in range(len(labels), points.shape[1])]
    if points.shape[1] > MOST_POINTS:
        raise ValueError(f"{points.shape[1]} points, more than {MOST_POINTS}")
    rate = np.asarray(group.get("RATE", {}).get("value", [0.0]), dtype=np.float64).ravel()
    return {"points": points}, {
        "labels": labels,
        "unit": (text("UNITS") or [""])[0].strip().lower(),
        "rate": float(rate[0]) if len(rate) else 0.0,
        "up": (text("Y_SCREEN") or [""])[0].strip().lower(),
        "residual": float(np.median(seen)) if len(seen) else 0.0,
        "occluded": int(hidden.sum()),
    }


def read_bag(path: str) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return the poses of one file of a ROS 2 bag and whose they are.

    Arrays, a row per pose: ``source``, its index in ``sources``; ``stamp`` and ``log`` (int64, ns), of its message's
    header (0: none) and of the recorder; ``pose`` (7), place and quaternion x, y, z, w, NaN for a point. ``sources``:
    ``name``, ``topic``, ``type``, ``frame``. ``others``: types of messages that were left out. Standard definitions of
    messages are used, never those in the file: rosbags would make code of them.
    """
    import numpy as np
    from rosbags.rosbag2 import Reader
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.LATEST)
    sources: dict[tuple[str, str, str, str], int] = {}
    rows: list[tuple[int, int, int]] = []
    poses: list[tuple[float, ...]] = []

    def add(name: str, topic: str, kind: str, frame: str, times: tuple[int, int], placed: Any) -> None:
        where = getattr(placed, "position", getattr(placed, "translation", placed))
        turn = getattr(placed, "orientation", getattr(placed, "rotation", None))
        quaternion = (math.nan,) * 4 if turn is None else (turn.x, turn.y, turn.z, turn.w)
        rows.append((sources.setdefault((name, topic, kind, frame), len(sources)), *times))
        poses.append((where.x, where.y, where.z, *quaternion))
        if len(rows) > MOST_POSES or len(sources) > MOST_POINTS:
            raise ValueError(f"more than {MOST_POSES} poses or {MOST_POINTS} things: record fewer topics")

    with Reader(path) as reader:
        wanted = [c for c in reader.connections if c.msgtype in STAMPED or c.msgtype in SEVERAL]
        others = sorted({c.msgtype for c in reader.connections} - {c.msgtype for c in wanted})
        for connection, log, raw in reader.messages(wanted) if wanted else ():
            kind, topic = connection.msgtype, connection.topic
            message: Any = store.deserialize_cdr(_unpacked(raw), kind)
            if kind == "tf2_msgs/msg/TFMessage":
                for entry in message.transforms:
                    times = (_stamp(entry.header), log)
                    add(entry.child_frame_id, topic, kind, entry.header.frame_id, times, entry.transform)
                continue
            times, frame = (_stamp(message.header), log), message.header.frame_id
            if kind == "geometry_msgs/msg/PoseArray":
                for index, pose in enumerate(message.poses):
                    add(f"{topic}[{index}]", topic, kind, frame, times, pose)
            else:
                name = message.child_frame_id if kind == "geometry_msgs/msg/TransformStamped" else topic
                add(name, topic, kind, frame, times, STAMPED[kind](message))
    found = np.array(rows, dtype=np.int64).reshape(-1, 3)
    arrays: dict[str, Any] = {"source": found[:, 0], "stamp": found[:, 1], "log": found[:, 2]}
    arrays["pose"] = np.array(poses, dtype=np.float64).reshape(-1, 7)
    keys = ("name", "topic", "type", "frame")
    return arrays, {"sources": [dict(zip(keys, source, strict=True)) for source in sources], "others": others}


def _stamp(header: Any) -> int:
    return int(header.stamp.sec) * 10**9 + int(header.stamp.nanosec)


def _unpacked(raw: bytes) -> bytes:
    """Return the message; ``ros2 bag record --compression-mode message`` packs each by itself."""
    if bytes(raw[:4]) != ZSTD:
        return raw
    if sys.version_info >= (3, 14):
        from compression import zstd
    else:
        from backports import zstd

    unpacker = zstd.ZstdDecompressor()
    return unpacker.decompress(bytes(raw), 2**26)


def main() -> None:
    """Read the file of the command line."""
    path, out, *places = sys.argv[1:]
    sys.path += [place for place in places if place not in sys.path]
    bound(Path(path))
    found: dict[str, Any]
    try:
        import numpy as np

        arrays, found = read_c3d(path) if path.endswith(".c3d") else read_bag(path)
        np.savez(Path(out, "arrays.npz"), **arrays)
    # Whatever a parser makes of damage: each has its own exceptions.
    except Exception as error:
        found = {"error": f"{type(error).__name__}: {error}"[:300]}
    Path(out, "found.json").write_text(json.dumps(found), encoding="utf-8")


if __name__ == "__main__":
    main()
