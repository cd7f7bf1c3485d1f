# SPDX-License-Identifier: MIT
"""Sealed labels: unreadable before, and unchangeable after, the diagnosis.

The labels are encrypted with a key that only this process's memory holds. Before the diagnosis starts, the SHA-256 of
salt and labels is published as a commitment that reveals nothing. Once all reports exist, the file is decrypted, the
hash compared, and salt and labels are published, so that anyone can verify them.

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

from ..sim.atomic import write_bytes, write_json
from ..sim.errors import InputError

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
