# SPDX-License-Identifier: MIT
"""The user's word for what came with a file and reaches beyond the file's own folder.

Everything in a file that starts a program, imports a module, calls an endpoint or reads outside its folder is a
``Claim``. A reader of such a file returns it as ``Untrusted``, which nothing but ``opened`` opens: for content without
claims, for content in the user's own list (``trusted.json``), or after the user agreed to the claims, line by line. An
adapter's specification that was parsed from JSON is an ``UntrustedSpec`` (``sim/validation.py``), no text, and what
starts adapters takes a ``TrustedSpec``. The threat model is in docs/security.md.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import secrets
import stat
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any, Generic, TypeVar

from .atomic import write_json
from .errors import InputError

T = TypeVar("T")

RUNS, READS, WRITES = "runs", "reads", "writes"

VARIABLE = "PHYSGEN_CONFIG"
LIST_FILE = "trusted.json"
LIST_FORMAT = "physgen-trust/1"
MOST_LIST_BYTES = 2**20
MOST_ENTRIES = 2000
"""Of the list; the oldest are forgotten, and asked about again."""


@dataclass(frozen=True, order=True)
class Claim:
    """One thing that a file asks for beyond its folder.

    kind: ``RUNS``, ``READS`` or ``WRITES``. where: its field. text: what would be run, read, or written and deleted.
    code: hash of the program that it names, as far as it is known; a changed program is another claim.
    """

    kind: str
    where: str
    text: str
    code: str = ""

    def line(self) -> str:
        """Return it as one line for the user; nothing in it can forge another line."""
        text = "".join(c if c.isprintable() else "\N{REPLACEMENT CHARACTER}" for c in self.text)
        return f"{self.kind:<5} {self.where} = {text[:500]}"


class NotTrusted(InputError):
    """Content that reaches beyond its folder, without the user's word. claims: what it asks for."""

    def __init__(self, message: str, claims: Sequence[Claim]) -> None:
        super().__init__(message)
        self.claims = tuple(claims)


Agreed = Callable[[Path, Sequence[Claim]], bool]
"""Shows the user the claims of a file and returns whether they agree."""


class UntrustedSpec:
    """An adapter's specification that came from a file: no text, so that it cannot be handed to what starts it, and no
    dataclass, so that it is not written to a file again."""

    __slots__ = ("__text",)

    def __init__(self, text: str) -> None:
        self.__text = text

    def __repr__(self) -> str:
        return f"UntrustedSpec({self.__text!r})"

    def claimed(self) -> str:
        """Return its text, to be shown."""
        return self.__text


class TrustedSpec(str):
    """An adapter's specification by the user's word: of a flag, of their own code, or agreed to."""

    __slots__ = ()


Spec = UntrustedSpec | str
"""In options: text where the user's code or command gave it, ``UntrustedSpec`` where a file did."""


def trusted_spec(spec: Spec) -> TrustedSpec:
    """Return ``spec`` for what starts it. Raises NotTrusted for one that came from a file."""
    if isinstance(spec, UntrustedSpec):
        raise NotTrusted(f"adapter {spec.claimed()[:200]!r}: came with a file, and nobody has agreed to it", ())
    return TrustedSpec(spec)


Replaced = Mapping[str, Any]
"""Values that the user gives anew, by the field of the file that they replace."""
NOTHING: Replaced = MappingProxyType({})


class Untrusted(Generic[T]):
    """The content of a file that nobody has agreed to yet. Nothing of it can be reached but by ``opened``."""

    __slots__ = ("__claims", "__content", "__released", "source")

    def __init__(
        self,
        source: Path,
        content: bytes,
        claims: Callable[[], Sequence[Claim]],
        released: Callable[[Replaced], T],
    ) -> None:
        """source, content: the file and its bytes. claims: returns what it asks for; released: returns it for use."""
        self.source = source
        self.__content, self.__claims, self.__released = content, claims, released

    def claims(self, replaced: Replaced = NOTHING) -> tuple[Claim, ...]:
        """Return what it asks for, without the fields ``replaced``."""
        return tuple(claim for claim in self.__claims() if claim.where not in replaced)

    def opened(self, agreed: Agreed | None = None, replaced: Replaced = NOTHING) -> T:
        """Return the content, with the values of ``replaced`` in place of its own.

        agreed: asked where it has claims and is not in the user's list, which it is then added to. Raises NotTrusted
        where there is nobody to ask, or the answer is no.
        """
        claims = self.claims(replaced)
        if claims and self._key() not in trusted_keys():
            if agreed is None or not agreed(self.source, claims):
                raise NotTrusted(refusal(self.source, claims), claims)
            self.remember()
        return self.__released(replaced)

    def remember(self) -> None:
        """Add the content to the user's list, as they made it or agreed to it."""
        if self.claims():
            remember(self._key(), self.source)

    def _key(self) -> str:
        whole = hashlib.sha256(self.__content)
        for claim in sorted(self.claims()):
            whole.update(f"\0{claim.code}".encode())
        return whole.hexdigest()


def refusal(source: Path, claims: Sequence[Claim]) -> str:
    """Return the message for content that was not agreed to."""
    lines = "\n".join(f"  {claim.line()}" for claim in claims)
    return (
        f"{source}: asks for what lies beyond its folder, and you have not agreed to it:\n{lines}\nIf the folder is "
        "yours, or you trust who made it, repeat the command with --trust; or give other values by their flags"
    )


def config_folder() -> Path:
    """Return the folder of the user's own settings; it need not exist.

    It is ``PHYSGEN_CONFIG`` if that is set, else ``physgen`` in ``XDG_CONFIG_HOME`` or ~/.config on Linux,
    ~/Library/Application Support on macOS, APPDATA on Windows.
    """
    given = os.environ.get(VARIABLE, "").strip()
    if given:
        return Path(given).expanduser().absolute()
    if os.name == "nt":
        roaming = os.environ.get("APPDATA", "").strip()
        return (Path(roaming) if roaming else Path.home() / "AppData" / "Roaming") / "physgen"
    if sys.platform == "darwin":
        return Path.home() / "Library" / "Application Support" / "physgen"
    # Relative paths are invalid by its specification.
    found = os.environ.get("XDG_CONFIG_HOME", "").strip()
    return (Path(found) if found.startswith("/") else Path.home() / ".config") / "physgen"


def trusted_keys() -> frozenset[str]:
    """Return the hashes of the contents that the user has agreed to, or made. An unusable list counts as empty."""
    return frozenset(entry["hash"] for entry in _entries())


def _entries() -> list[dict[str, str]]:
    try:
        with (config_folder() / LIST_FILE).open("rb") as file:
            about = os.fstat(file.fileno())
            # Where others may write it, it is not the user's word; Windows keeps the folder to its user.
            if os.name != "nt" and not (
                stat.S_ISREG(about.st_mode)
                and not about.st_mode & (stat.S_IWGRP | stat.S_IWOTH)
                and about.st_uid == os.getuid()
            ):
                return []
            content = file.read(MOST_LIST_BYTES + 1)
        if len(content) > MOST_LIST_BYTES:
            return []
        data = json.loads(content)
        found = data["folders"] if data["format"] == LIST_FORMAT else []
        good = [entry for entry in found if isinstance(entry.get("hash"), str) and isinstance(entry.get("file"), str)]
        return good[-MOST_ENTRIES:]
    except (OSError, ValueError, TypeError, KeyError, AttributeError, RecursionError):
        return []


def remember(key: str, source: Path) -> None:
    """Add the content with the hash ``key`` to the user's list; ``source`` is noted for people.

    The list is for the user alone (0600). Where it cannot be written, they are asked again the next time.
    """
    if key in trusted_keys():
        return
    entries = [*_entries(), {"hash": key, "file": str(source.absolute())}][-MOST_ENTRIES:]
    folder = config_folder()
    with contextlib.suppress(OSError, InputError):
        folder.mkdir(parents=True, exist_ok=True, mode=0o700)
        write_json(folder / LIST_FILE, {"format": LIST_FORMAT, "folders": entries}, mode=0o600)


MOST_CODE_FILES = 2000
MOST_CODE_BYTES = 64 * 2**20
MOST_LOOKED_AT = 100_000
"""Files and folders."""
_CODE = (".py", ".pyc", ".pyd", ".so", ".dll", ".dylib", ".sh", ".bat", ".cmd", ".exe", ".toml", ".pth", ".jar", ".js")
UNKNOWN = "asked every time, as there is too much code beside it to remember"


def code_hash(places: Sequence[Path]) -> str:
    """Return a hash over the code at ``places``: each a file, or a folder with all code in it.

    Links are followed, as imports follow them. Beyond ``MOST_CODE_FILES``, ``MOST_CODE_BYTES`` or ``MOST_LOOKED_AT`` it
    is a new one at every call, so that nothing is remembered.
    """
    whole, left = hashlib.sha256(), MOST_CODE_BYTES
    count = 0
    for place in places:
        for path in _code_files(place):
            count += 1
            try:
                left -= path.stat().st_size
                if count > MOST_CODE_FILES or left < 0 or path.is_dir():  # a folder: too much is in it
                    return f"{UNKNOWN} {secrets.token_hex(16)}"
                whole.update(f"{path}\0".encode(errors="surrogateescape") + hashlib.sha256(path.read_bytes()).digest())
            except OSError:
                whole.update(f"{path}\0missing".encode(errors="surrogateescape"))
    return whole.hexdigest()


def _code_files(place: Path) -> Iterator[Path]:
    """Yield the files at ``place`` that may be run or imported; the folder where they are too many to look at."""
    if place.is_file():
        yield place
        return
    seen: set[str] = set()
    looked = 0
    for root, folders, names in os.walk(place, followlinks=True):
        looked += len(folders) + len(names)
        if looked > MOST_LOOKED_AT:
            yield Path(root)
            return
        real = os.path.realpath(root)
        if real in seen:
            # Links in a circle, or two to one folder.
            folders[:] = []
            continue
        seen.add(real)
        folders[:] = sorted(name for name in folders if name != "__pycache__")
        for name in sorted(names):
            path = Path(root) / name
            runs = name.lower().endswith(_CODE) or (os.name != "nt" and os.access(path, os.X_OK))
            if runs and path.is_file():
                yield path
