# SPDX-License-Identifier: GPL-3.0-or-later
"""Who may talk to whom in a Dask farm. Its messages are pickles: whoever may connect may run anything."""

from __future__ import annotations

import ipaddress
import ssl
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

from ...sim.errors import InputError


def file_security(address: str, ca: Path | None, cert: Path | None, key: Path | None) -> Any:
    """Dask's ``Security`` for a scheduler at ``address``; None for ``tcp://``.

    Raises InputError for an address that is none, for TLS without its three files or files that are none, and for files
    with an address that does not use them.
    """
    try:
        parts = urlsplit(address)
        scheme, known = parts.scheme, bool(parts.hostname and parts.port)
    except ValueError:
        scheme, known = "", False
    if scheme not in ("tcp", "tls") or not known:
        raise InputError(f"{address!r} is no address of a scheduler: write tcp://HOST:PORT or tls://HOST:PORT")
    files = {"--tls-ca": ca, "--tls-cert": cert, "--tls-key": key}
    given = [option for option, path in files.items() if path is not None]
    if scheme == "tcp":
        if given:
            raise InputError(f"{given[0]} is of no use with {address}: start the scheduler with TLS and write tls://…")
        return None
    missing = [option for option, path in files.items() if path is None]
    if missing:
        raise InputError(f"{missing[0]} is missing: {address} needs --tls-ca, --tls-cert and --tls-key")
    assert ca is not None and cert is not None and key is not None
    for option, path in files.items():
        if path is not None and not path.is_file():
            raise InputError(f"{option} {path}: there is no such file")
    try:
        context = ssl.create_default_context(cafile=str(ca))
        context.load_cert_chain(cert, key)
    except OSError as error:
        raise InputError(
            f"{ca}, {cert}, {key}: cannot be used ({error}); give PEM files that belong together"
        ) from error
    from distributed.security import Security

    return Security(
        require_encryption=True,
        tls_ca_file=str(ca),
        **{f"tls_{role}_cert": str(cert) for role in ("client", "worker")},
        **{f"tls_{role}_key": str(key) for role in ("client", "worker")},
    )


def check_trust(address: str, *, trust_network: bool) -> None:
    """Raise InputError for a scheduler on another machine that is talked to in the clear, unless that is wanted."""
    host = urlsplit(address).hostname or ""
    try:
        local = ipaddress.ip_address(host).is_loopback
    except ValueError:
        local = host == "localhost"
    if address.startswith("tcp://") and not local and not trust_network:
        raise InputError(
            f"{address} is another machine and uses no TLS, so whoever reaches it can run commands as you: "
            "use tls://…, or --trust-network where everybody on the network may"
        )
