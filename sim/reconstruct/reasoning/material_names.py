# SPDX-License-Identifier: MIT
"""Usual physics of objects by name: ``presets/names.toml``, which cites the sources of its numbers."""

from __future__ import annotations

import functools
import re
import unicodedata
from collections.abc import Container, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any

from ...errors import InputError
from ...files import read_toml
from ...scene.material import preset_names
from ...validation import parse
from ..reconstruct_options import SHAPES

NAMES_FILE = Path(__file__).resolve().parents[3] / "presets" / "names.toml"
MAX_FILE_BYTES = 512 * 2**10
MAX_WORDS = 12
"""Largest number of words in a name; longer text is a sentence."""

_IRREGULAR = {"men": "man", "women": "woman", "children": "child", "people": "person", "mice": "mouse", "feet": "foot"}
_PORTIONS = frozenset(
    "bar bunch chunk couple cube group heap lump pair piece pile scoop set slice stack stick".split()  # noqa: SIM905
)
_BEFORE = re.compile(r"\s(?:with|on|in|under|beside|for|from)\s.*")


@dataclass(frozen=True, kw_only=True)
class NamedPhysics:
    """Usual physics of a kind of object.

    name: its name in the table. preset: material preset. density: kg/m³ of the body, consistent with ``fill``. fill:
    whether the whole interior is filled. size_m: typical longest extent in metres; None for a bare material. roughness:
    of the surface, 0 (polished) to 1 (coarse), for its friction. metallic, appearance_roughness: 0 to 1, of its shader.
    shape: one of the body's shapes, or "auto". thickness: depth over width, or None.
    """

    name: str
    preset: str
    density: float
    fill: bool
    size_m: float | None
    roughness: float
    metallic: float
    appearance_roughness: float
    shape: str = "auto"
    thickness: float | None = None


@dataclass(frozen=True, kw_only=True)
class _Matter:
    preset: str
    density: float
    roughness: float
    metallic: float
    appearance_roughness: float
    fill: bool | None = None
    modifies: bool = True
    also: tuple[str, ...] = ()


@dataclass(frozen=True, kw_only=True)
class _Thing:
    matter: str
    size_m: float
    share: float = 1.0
    density: float | None = None
    preset: str | None = None
    fill: bool | None = None
    roughness: float | None = None
    metallic: float | None = None
    appearance_roughness: float | None = None
    shape: str = "auto"
    thickness: float | None = None
    also: tuple[str, ...] = ()


@dataclass(frozen=True)
class NameTable:
    """Usual physics by name; ``find`` looks up a name."""

    things: Mapping[str, NamedPhysics] = field(default_factory=lambda: MappingProxyType({}))
    matters: Mapping[str, NamedPhysics] = field(default_factory=lambda: MappingProxyType({}))
    matter_of: Mapping[str, str] = field(default_factory=lambda: MappingProxyType({}))
    """Name of an object → name of its material."""
    modifiers: frozenset[str] = frozenset()
    """Material words that may precede an object."""
    given_fill: frozenset[str] = frozenset()
    """Materials whose objects are solid throughout."""

    def find(self, name: str | None) -> NamedPhysics | None:
        """Return the usual physics of ``name``; None if the table does not contain it.

        Case, plural, underscores, joined words and trailing numbers do not matter. The last words decide ("coffee mug"
        is a mug), or those before "of"; a material in front of them replaces the usual one ("wooden spoon"), and the
        density changes in proportion.
        """
        words = _words(name or "")
        for start in range(len(words)):
            tail = words[start:]
            matters = [m for word in reversed(words[:start]) if (m := self._modifier(word))]
            for form in _singulars(tail):
                thing = self.things.get(form) or (self._joined(form) if len(tail) == 1 else None)
                if thing is not None:
                    return self._of_matter(thing, matters[0]) if matters else thing
                if form in self.matters:
                    return self.matters[form]
        matters = [m for word in reversed(words) if (m := self._modifier(word))]
        return self.matters[matters[0]] if matters else None

    def _modifier(self, word: str) -> str | None:
        return next((form for form in _singulars([word]) if form in self.modifiers), None)

    def _joined(self, word: str) -> NamedPhysics | None:
        """``word`` as two joined words, the last of which is in the table."""
        for cut in range(4, len(word) - 3):
            if word[cut:] in self.things:
                return self.things[word[cut:]]
        return None

    def _of_matter(self, thing: NamedPhysics, matter: str) -> NamedPhysics:
        made_of = self.matters[matter]
        usual = self.matters[self.matter_of[thing.name]]
        if made_of.name == usual.name:
            return thing
        solid = made_of.name in self.given_fill
        return replace(
            thing,
            name=f"{matter} {thing.name}",
            preset=made_of.preset,
            density=made_of.density if solid else min(23_000.0, thing.density * made_of.density / usual.density),
            fill=solid or thing.fill,
            roughness=made_of.roughness,
            metallic=made_of.metallic,
            appearance_roughness=made_of.appearance_roughness,
        )


@functools.cache
def shipped_names() -> NameTable:
    """Return the table shipped with PhysGen."""
    return load_names(NAMES_FILE)


def load_names(path: Path) -> NameTable:
    """Return the table in the TOML file ``path``. Raises InputError, which names the entry, for one that cannot be
    used."""
    data = _read(path)
    matters: dict[str, NamedPhysics] = {}
    things: dict[str, NamedPhysics] = {}
    matter_of: dict[str, str] = {}
    modifiers: set[str] = set()
    given_fill: set[str] = set()
    for key, value in _table(data.pop("matter", {}), f"{path}: matter").items():
        matter = parse(_Matter, value, f"{path}: matter.{key}")
        known = _matter(_plain(key), matter)
        _check(known, f"{path}: matter.{key}")
        for name in (key, *matter.also):
            _check_new(name, matters, f"{path}: matter.{key}")
            matters[_plain(name)] = known
            modifiers |= {_plain(name)} if matter.modifies else set()
        given_fill |= {known.name} if matter.fill else set()
    plain_things: set[str] = set()
    for group, entries in _table(data.pop("things", {}), f"{path}: things").items():
        for key, value in _table(entries, f"{path}: things.{group}").items():
            where = f"{path}: things.{group}.{key}"
            thing = parse(_Thing, value, where)
            if _plain(thing.matter) not in matters:
                raise InputError(f"{where}.matter: {thing.matter!r} is not among the matters of this file")
            if not 0 < thing.share <= 1:
                raise InputError(f"{where}.share is {thing.share!r}: give a part above 0, up to 1")
            known = _thing(_plain(key), thing, matters[_plain(thing.matter)])
            _check(known, where)
            matter_of[known.name] = matters[_plain(thing.matter)].name
            for name in (key, *thing.also):
                _check_new(name, plain_things, where)
                plain_things.add(_plain(name))
                # "teddybear" as well as "teddy bear".
                things[_plain(name)] = things[_plain(name).replace(" ", "")] = known
    if data:
        raise InputError(f"{path}: {sorted(data)[0]!r} is unknown; there are [matter] and [things.GROUP]")
    return NameTable(
        things=MappingProxyType(things),
        matters=MappingProxyType(matters),
        matter_of=MappingProxyType(matter_of),
        modifiers=frozenset(modifiers),
        given_fill=frozenset(given_fill),
    )


def _read(path: Path) -> dict[str, Any]:
    try:
        return read_toml(path, MAX_FILE_BYTES, what="table of names")
    except FileNotFoundError:
        raise InputError(f"{path}: not readable as TOML (there is no such file)") from None


def _table(value: Any, where: str) -> dict[str, Any]:
    if not isinstance(value, dict):
        raise InputError(f"{where}: expected a table, found {str(value)[:60]!r}")
    return value


def _matter(name: str, matter: _Matter) -> NamedPhysics:
    return NamedPhysics(
        name=name,
        preset=matter.preset,
        density=matter.density,
        fill=matter.fill is not False,
        size_m=None,
        roughness=matter.roughness,
        metallic=matter.metallic,
        appearance_roughness=matter.appearance_roughness,
    )


def _thing(name: str, thing: _Thing, matter: NamedPhysics) -> NamedPhysics:
    def own(value: Any, usual: Any) -> Any:
        return usual if value is None else value

    return NamedPhysics(
        name=name,
        preset=own(thing.preset, matter.preset),
        density=own(thing.density, thing.share * matter.density),
        fill=own(thing.fill, matter.fill),
        size_m=thing.size_m,
        roughness=own(thing.roughness, matter.roughness),
        metallic=own(thing.metallic, matter.metallic),
        appearance_roughness=own(thing.appearance_roughness, matter.appearance_roughness),
        shape=thing.shape,
        thickness=thing.thickness,
    )


def _check_new(name: str, known: Container[str], where: str) -> None:
    if not _plain(name) or _plain(name) in known:
        raise InputError(f"{where}: {name!r} is not a word, or occurs twice in this table; remove one")


def _check(item: NamedPhysics, where: str) -> None:
    if not re.fullmatch(r"[a-z][a-z ]*", item.name):
        raise InputError(f"{where}: name {item.name!r} has characters other than letters; use letters and '_'")
    if item.preset not in preset_names():
        raise InputError(f"{where}.preset is {item.preset!r}: choose one of {', '.join(preset_names())}")
    if item.shape not in SHAPES:
        raise InputError(f"{where}.shape is {item.shape!r}: choose one of {', '.join(SHAPES)}")
    for name, low, high in (
        ("density", 1.0, 23_000.0),
        ("size_m", 1e-3, 200.0),
        ("roughness", 0.0, 1.0),
        ("metallic", 0.0, 1.0),
        ("appearance_roughness", 0.0, 1.0),
        ("thickness", 0.02, 3.0),
    ):
        value = getattr(item, name)
        if value is not None and not low <= value <= high:
            raise InputError(f"{where}.{name} is {value!r}: give {low:g} to {high:g}")


def _plain(name: str) -> str:
    """Lower case, without accents and punctuation, single spaces."""
    name = re.sub(r"(?<=[a-z])(?=[A-Z])", " ", name)
    letters = "".join(c for c in unicodedata.normalize("NFKD", name) if not unicodedata.combining(c)).casefold()
    return " ".join(re.sub(r"[\W\d_]+", " ", letters).split())


def _words(name: str) -> list[str]:
    """The words of ``name`` that identify the object."""
    text = _BEFORE.sub("", _plain(name[:200]))
    first, of, rest = text.partition(" of ")
    if of and first.split()[-1:] and first.split()[-1].rstrip("s") in _PORTIONS:
        first = rest
    elif of:
        # "ball of yarn" may be in the table as a whole.
        first = text if rest == "yarn" or rest == "wool" else first
    words = first.split()
    while words and words[0] in ("a", "an", "the", "my", "one", "two", "some"):
        words = words[1:]
    return words[-MAX_WORDS:]


def _singulars(words: Sequence[str]) -> Iterator[str]:
    """``words`` joined, as they are and with the last one in each possible singular."""
    lead, last = list(words[:-1]), words[-1]
    forms = [last, _IRREGULAR.get(last, last)]
    if last.endswith("ies"):
        forms.append(last[:-3] + "y")
    if last.endswith("ves"):
        forms += [last[:-3] + "f", last[:-3] + "fe"]
    if last.endswith("es"):
        forms.append(last[:-2])
    if last.endswith("s") and not last.endswith("ss"):
        forms.append(last[:-1])
    for form in dict.fromkeys(forms):
        yield " ".join([*lead, form])
