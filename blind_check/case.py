# SPDX-License-Identifier: MIT
"""A generated case: its capture, ground truth and camera; and its labels, sealed until all reports exist.

Sealed labels are unreadable before, and unchangeable after, the diagnosis. They are encrypted with a key that only this
process's memory holds. Before the diagnosis starts, the SHA-256 of salt and labels is published as a commitment that
reveals nothing. Once all reports exist, the file is decrypted, the hash compared, and salt and labels are published, so
that anyone can verify them.

Not prevented: root, and on systems other than Linux the same user with a debugger, can read the memory of a process. A
seed given on the command line is visible there; omit it where that matters.
"""

from __future__ import annotations

import ctypes
import hashlib
import hmac
import json
import secrets
import sys
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..sim.atomic import write_bytes, write_json
from ..sim.diagnose.capture import Camera, Capture
from ..sim.diagnose.diagnosis import NONE
from ..sim.errors import InputError
from .mujoco_world import Array

_BYTES = 32
_PR_SET_DUMPABLE = 4


@dataclass(frozen=True, kw_only=True)
class Seal:
    """A seal. digest: hex SHA-256 of salt and canonical labels, published at once. The rest stays in memory."""

    digest: str
    path: Path
    salt: bytes = field(repr=False)
    key: bytes = field(repr=False)


def canonical(labels: Mapping[str, Any]) -> bytes:
    """Return the canonical bytes of ``labels``: JSON with sorted keys and no blanks, UTF-8."""
    text = json.dumps(labels, sort_keys=True, separators=(",", ":"), ensure_ascii=False, allow_nan=False)
    return text.encode("utf-8")


def digest_of(salt: bytes, labels: Mapping[str, Any]) -> str:
    """Return the hex SHA-256 of ``salt`` followed by the canonical ``labels``."""
    return hashlib.sha256(salt + canonical(labels)).hexdigest()


def seal(labels: Mapping[str, Any], path: Path) -> Seal:
    """Write the encrypted ``labels`` to ``path``, readable by its owner only, with fresh salt and key."""
    salt, key = secrets.token_bytes(_BYTES), secrets.token_bytes(_BYTES)
    write_bytes(path, _ciphered(canonical(labels), key))
    path.chmod(0o600)
    return Seal(digest=digest_of(salt, labels), path=path, salt=salt, key=key)


def break_seal(sealed: Seal) -> dict[str, Any]:
    """Return the labels. Raises InputError when the file does not match the digest."""
    try:
        labels = json.loads(_ciphered(sealed.path.read_bytes(), sealed.key).decode("utf-8"))
    except (OSError, ValueError) as error:
        raise InputError(f"{sealed.path}: the sealed labels were changed or removed ({error}); check again") from None
    if not isinstance(labels, dict) or not hmac.compare_digest(digest_of(sealed.salt, labels), sealed.digest):
        raise InputError(f"{sealed.path}: the sealed labels do not have the published hash: they were changed")
    return labels


def publish(sealed: Seal, labels: Mapping[str, Any], path: Path) -> None:
    """Write salt, digest and ``labels`` in the clear."""
    write_json(path, {"digest": sealed.digest, "salt": sealed.salt.hex(), "labels": labels})


def verify(path: Path) -> dict[str, Any]:
    """Return the labels that ``publish`` wrote to ``path``. Raises InputError when they do not match their digest."""
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
        salt, labels, digest = bytes.fromhex(data["salt"]), data["labels"], str(data["digest"])
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise InputError(f"{path}: no published labels ({error})") from None
    if not hmac.compare_digest(digest_of(salt, labels), digest):
        raise InputError(f"{path}: the labels do not have the hash {digest}: they were changed")
    return dict(labels)


def keep_memory_private() -> bool:
    """Keep other processes of the user from reading this one's memory (Linux); return whether that worked."""
    if sys.platform != "linux":
        return False
    try:
        return ctypes.CDLL(None).prctl(_PR_SET_DUMPABLE, 0, 0, 0, 0) == 0
    except (OSError, AttributeError):
        return False


def _ciphered(content: bytes, key: bytes) -> bytes:
    """Return ``content`` XOR the SHAKE-256 stream of ``key``, which is its own inverse. A key is used once."""
    stream = hashlib.shake_256(key).digest(len(content))
    return bytes(a ^ b for a, b in zip(content, stream, strict=True))


@dataclass(frozen=True, kw_only=True)
class TrialTruth:
    """Ground truth of one trial. T frames shown, P withheld, K points.

    points: (T, K, 3) m without noise; active: (T,) whether the cause acts; withheld: (P, K, 3) m and withheld_active:
    (P,), of a predict trial. point_mask: (K,) the points on which it acts, None for all.
    """

    points: Array
    active: NDArray[np.bool_]
    withheld: Array | None = None
    withheld_active: NDArray[np.bool_] | None = None
    point_mask: NDArray[np.bool_] | None = None


@dataclass(frozen=True, kw_only=True)
class Truth:
    """Truth of a case. effects: the causes, strongest first; () for ``none`` and ``unknown``. mechanism: in words.

    oracle_rms_m: error of the true model on withheld frames, started from the shown frames.
    effect_rms_over_noise: size of the effect. ambiguous_with: effects indistinguishable in such data → reason.
    """

    effect: str
    effects: tuple[str, ...]
    mechanism: str
    simulator: str
    parameters: Mapping[str, Any]
    oracle_rms_m: float
    effect_rms_over_noise: float
    trials: Mapping[str, TrialTruth]
    ambiguous_with: Mapping[str, str] = field(default_factory=dict)
    notes: Mapping[str, Any] = field(default_factory=dict)

    def label(self) -> dict[str, Any]:
        """Return the part that is sealed, as plain JSON values: everything but the arrays."""
        return {
            "effect": self.effect,
            "effects": list(self.effects),
            "mechanism": self.mechanism,
            "simulator": self.simulator,
            "parameters": dict(self.parameters),
            "ambiguous_with": dict(self.ambiguous_with),
            "oracle_rms_m": self.oracle_rms_m,
            "effect_rms_over_noise": self.effect_rms_over_noise,
            **self.notes,
        }

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Return ``TAKE.points``, ``TAKE.effect_active`` and, if present, ``points_predict``, ``point_mask``."""
        out: dict[str, NDArray[Any]] = {}
        for name, trial in self.trials.items():
            out[f"{name}.points"] = trial.points.astype(np.float32)
            out[f"{name}.effect_active"] = trial.active
            if trial.withheld is not None and trial.withheld_active is not None:
                out[f"{name}.points_predict"] = trial.withheld.astype(np.float32)
                out[f"{name}.effect_active_predict"] = trial.withheld_active
            if trial.point_mask is not None and self.effect != NONE:
                out[f"{name}.point_mask"] = trial.point_mask
        return out


@dataclass(frozen=True, kw_only=True)
class BlindCase:
    """The capture that the diagnosis sees, and the truth that it must not see."""

    capture: Capture
    truth: Truth


@dataclass(frozen=True, kw_only=True)
class Lens:
    """Radial lens distortion k1 in x (1 + k1 r²), 0 for a pinhole."""

    k1: float = 0.0


def drop_points(frames: int, points: int, share: float, rng: np.random.Generator) -> Array:
    """Return a mask (T, K) of points lost in runs of 2 to 12 frames, about ``share`` of all."""
    out = np.zeros((frames, points), dtype=bool)
    mean = 5.0
    for point in range(points):
        wanted = share * float(rng.exponential())
        frame = 0
        while True:
            frame += 1 + int(rng.exponential(mean * (1 - min(wanted, 0.8)) / max(min(wanted, 0.8), 1e-3)))
            if frame >= frames:
                break
            run = int(np.clip(rng.exponential(mean), 2, 12))
            out[frame : frame + run, point] = True
            frame += run
    # The initial state must be observable: never lose all points of a frame.
    crowded = out.mean(axis=1) > 0.6
    out[crowded] = False
    return out


def project(points: Array, camera: Camera, lens: Lens) -> Array:
    """Return pixels (…, 2) of world ``points`` (…, 3)."""
    world_from_camera = camera.matrix
    local = (points - world_from_camera[:3, 3]) @ world_from_camera[:3, :3]
    flat = local[..., :2] / local[..., 2:]
    flat = flat * (1 + lens.k1 * np.sum(flat**2, axis=-1, keepdims=True))
    return np.asarray(flat * (camera.fx, camera.fy) + (camera.cx, camera.cy))


def draw_camera(target: Array, distance: float, rng: np.random.Generator) -> Camera:
    """Return a camera that looks at ``target`` from ``distance`` m, slightly from above."""
    azimuth, height = rng.uniform(-np.pi, np.pi), rng.uniform(0.3, 0.45)
    back = np.array([np.cos(azimuth) * np.cos(height), np.sin(azimuth) * np.cos(height), np.sin(height)])
    eye = target + distance * back
    forward = -back
    right = np.cross(forward, (0.0, 0.0, 1.0))
    right /= np.linalg.norm(right)
    return _camera(np.column_stack([right, np.cross(forward, right), forward]), eye, float(rng.uniform(840, 980)))


def moved_camera(camera: Camera, rotation: Array, shift: Array) -> Camera:
    """Return ``camera`` rotated by ``rotation`` about the world's origin and translated by ``shift`` m."""
    matrix = camera.matrix
    return _camera(rotation @ matrix[:3, :3], rotation @ matrix[:3, 3] + shift, camera.fx)


def _camera(turn: Array, eye: Array, focal: float) -> Camera:
    rows = [(*map(float, turn[i]), float(eye[i])) for i in range(3)] + [(0.0, 0.0, 0.0, 1.0)]
    return Camera(
        width=1280,
        height=720,
        fx=focal,
        fy=focal,
        cx=640.0,
        cy=360.0,
        world_from_camera=tuple((r[0], r[1], r[2], r[3]) for r in rows),
    )
