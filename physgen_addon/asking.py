# SPDX-License-Identifier: GPL-3.0-or-later
"""Who has agreed to send a photo where, and whether Blender lets it. Nothing of it is in any file."""

from __future__ import annotations

import ipaddress
from urllib.parse import urlsplit

_agreed: set[tuple[int, str]] = set()
"""A scene's ``session_uid`` and the address; both are others in the next file, so an agreement never is remembered."""

OFFLINE = (
    "Blender's preferences keep it offline (System > Network > Allow Online Access), and the address is not on this "
    "machine"
)


def is_agreed(scene_uid: int, url: str) -> bool:
    """Whether the photo of that scene may be sent to ``url``."""
    return (scene_uid, url) in _agreed


def agree(scene_uid: int, url: str, *, agreed: bool) -> None:
    """Remember it until Blender ends; of each scene the last address alone."""
    _agreed.difference_update([entry for entry in _agreed if entry[0] == scene_uid])
    if agreed:
        _agreed.add((scene_uid, url))


def forget() -> None:
    """Nobody has agreed to anything."""
    _agreed.clear()


def is_this_machine(url: str) -> bool:
    """Whether nothing that is sent to ``url`` leaves the computer."""
    try:
        host = urlsplit(url.strip()).hostname or ""
        return host == "localhost" or ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def is_allowed(url: str, *, online: bool) -> bool:
    """Whether ``url`` may be asked. online: Blender's own preference."""
    return online or is_this_machine(url)
