# SPDX-License-Identifier: MIT
"""Labels that nobody can read before, or change after, the diagnosis.

The labels are enciphered with a key that only this process's memory holds. Before the diagnosis starts, the SHA-256 of
salt and labels is made known: it commits to them and tells nothing about them. Once all reports are in, the key opens
the file, the hash is compared, and salt and labels are published, so that anybody can compare them again.

What this does not stop: root, and on systems other than Linux the same user with a debugger, can read the memory of a
process. A seed given on the command line is readable there; leave it out where that matters.
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

from ...atomic import write_bytes, write_json
from ...errors import InputError

_BYTES = 32
_PR_SET_DUMPABLE = 4


@dataclass(frozen=True, kw_only=True)
class Seal:
    """digest: hex SHA-256 of salt and canonical labels, to be published at once. The rest stays in memory."""

    digest: str
    path: Path
    salt: bytes = field(repr=False)
    key: bytes = field(repr=False)


def canonical(labels: Mapping[str, Any]) -> bytes:
    """The one spelling of ``labels`` that is hashed: JSON with sorted keys and no blanks, UTF-8."""
    text = json.dumps(labels, sort_keys=True, separators=(",", ":"), ensure_ascii=False, allow_nan=False)
    return text.encode("utf-8")


def digest_of(salt: bytes, labels: Mapping[str, Any]) -> str:
    """Hex SHA-256 of ``salt`` followed by the canonical ``labels``."""
    return hashlib.sha256(salt + canonical(labels)).hexdigest()


def seal(labels: Mapping[str, Any], path: Path) -> Seal:
    """Write ``labels``, enciphered, to ``path``, readable by its owner alone; salt and key are drawn afresh."""
    salt, key = secrets.token_bytes(_BYTES), secrets.token_bytes(_BYTES)
    write_bytes(path, _ciphered(canonical(labels), key))
    path.chmod(0o600)
    return Seal(digest=digest_of(salt, labels), path=path, salt=salt, key=key)


def break_seal(sealed: Seal) -> dict[str, Any]:
    """The labels. Raises InputError when the file is not what the digest promised."""
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
    """The labels that ``publish`` wrote to ``path``; InputError when they do not have the digest beside them."""
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
        salt, labels, digest = bytes.fromhex(data["salt"]), data["labels"], str(data["digest"])
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise InputError(f"{path}: no published labels ({error})") from None
    if not hmac.compare_digest(digest_of(salt, labels), digest):
        raise InputError(f"{path}: the labels do not have the hash {digest}: they were changed")
    return dict(labels)


def keep_memory_private() -> bool:
    """Ask Linux not to let other processes of the same user look into this one's memory; whether it agreed."""
    if sys.platform != "linux":
        return False
    try:
        return ctypes.CDLL(None).prctl(_PR_SET_DUMPABLE, 0, 0, 0, 0) == 0
    except (OSError, AttributeError):
        return False


def _ciphered(content: bytes, key: bytes) -> bytes:
    """``content`` with SHAKE-256's stream of ``key`` laid over it; twice gives it back. A key is used once."""
    stream = hashlib.shake_256(key).digest(len(content))
    return bytes(a ^ b for a, b in zip(content, stream, strict=True))
