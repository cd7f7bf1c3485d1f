# SPDX-License-Identifier: GPL-3.0-or-later
"""Consent to send a photo to a reasoning service, and whether Blender is allowed online. Never saved to a file."""

from __future__ import annotations

import ipaddress
from urllib.parse import urlsplit

_agreed: set[tuple[int, str]] = set()
"""Scene ``session_uid`` and address; both change with the file, so consent never persists."""

OFFLINE = (
    "Blender is set to stay offline (Preferences > System > Network > Allow Online Access), and the address is not on "
    "this machine"
)


def is_agreed(scene_uid: int, url: str) -> bool:
    """Return whether the photo of that scene may be sent to ``url``."""
    return (scene_uid, url) in _agreed


def agree(scene_uid: int, url: str, *, agreed: bool) -> None:
    """Remember consent until Blender exits; for the last address of each scene only."""
    _agreed.difference_update([entry for entry in _agreed if entry[0] == scene_uid])
    if agreed:
        _agreed.add((scene_uid, url))


def forget() -> None:
    """Withdraw all consents."""
    _agreed.clear()


def is_this_machine(url: str) -> bool:
    """Return whether ``url`` is on this computer."""
    try:
        host = urlsplit(url.strip()).hostname or ""
        return host == "localhost" or ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def is_allowed(url: str, *, online: bool) -> bool:
    """Return whether ``url`` may be contacted. online: Blender's own preference."""
    return online or is_this_machine(url)
