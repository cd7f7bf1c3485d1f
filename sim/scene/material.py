# SPDX-License-Identifier: MIT
"""An object's material, and material presets: one TOML file each, shipped or the user's own."""

from __future__ import annotations

import dataclasses
import itertools
import json
import math
import unicodedata
from dataclasses import dataclass
from pathlib import Path

from ..atomic import replacing
from ..constitutive import RIGID, models
from ..errors import InputError
from ..files import read_toml
from ..validation import DEVICES, finite, may_be_named, parse, quantity, require, require_quantities

LAWS = (*(model.law for model in models()), RIGID)
"""Constitutive models by name, and RIGID."""


def _with_parameters_of_models(material: type[Material]) -> type[Material]:
    """``material`` with the fields that models add to it, see ``DeformableMaterial.parameters``."""
    own = [(p.name, float, quantity(p.default, p.low, p.high, p.unit)) for model in models() for p in model.parameters]
    if not own:
        return material
    made = dataclasses.make_dataclass(material.__name__, own, bases=(material,), frozen=True, kw_only=True)
    made.__module__, made.__doc__ = material.__module__, material.__doc__
    return made


@_with_parameters_of_models
@dataclass(frozen=True, kw_only=True)
class Material:
    """Constitutive model and parameters of an object's material.

    preset: name of the preset in ``presets/materials`` that the numbers come from, or "custom".
    density: kg/m³, above 0 and up to 30000.
    youngs_modulus: Pa, 1e2 to 1e12.
    poisson_ratio: 0 to 0.49.
    law: constitutive model, one of ``LAWS``: elastic; elastic at large strain; plastic (clay, metal); snow; sand;
        fluid; rigid, of which only the density counts.
    damping_time: s, 0 to 10; Kelvin–Voigt retardation time viscosity / modulus of solids. A vibration of angular
        frequency w decays at the rate damping_time w² / 2.
    relaxing_share, relaxation_time: 0 (none) to 20, and 1e-5 to 100 s; of ``fixed_corotated`` and ``neo_hookean``:
        shear modulus, over the law's own, of a spring beside it that gives way in this time (standard linear solid). It
        is what keeps soft toys and foam from bouncing for ever: the loss factor is at most
        share / (2 sqrt(1 + share)), at the angular frequency 1 / (relaxation_time sqrt(1 + share)).
    rigid_restitution: 0 to 1; of ``rigid``: speed of leaving over speed of approach on what does not deform either,
        where neither object nor ground say one.
    yield_stress: Pa, 1 to 1e12; of ``von_mises``, in tension.
    friction_angle: radians, 0.01 to 1.4; of ``sand``, internal.
    critical_compression, critical_stretch: strains, 1e-4 to 0.5; elastic limits of ``snow``.
    hardening: 0 to 30; of ``snow``, its moduli grow by exp(hardening (1 - J)) when packed to the volume ratio J.
    bulk_modulus: Pa, 10 to 1e12; of ``fluid``, in place of Young's modulus and Poisson's ratio.
    viscosity: Pa s, 0 to 1e5; of ``fluid``, dynamic.
    fibre_modulus: Pa, 0 (none) to 1e12; of ``fixed_corotated`` and ``neo_hookean``: Young's modulus added along the
        fibre axis.
    fibre_axis: unit vector of the fibres in the body at rest, world axes.

    Parameters of other laws than the material's own are stored but unused.
    """

    preset: str = "custom"
    density: float = quantity(1000.0, 0.0, 3e4, "kg/m³")
    youngs_modulus: float = quantity(5e5, 1e2, 1e12, "pascals")
    poisson_ratio: float = quantity(0.3, 0.0, 0.49)
    law: str = "fixed_corotated"
    damping_time: float = quantity(0.0, 0.0, 10.0, "seconds")
    relaxing_share: float = quantity(0.0, 0.0, 20.0)
    relaxation_time: float = quantity(0.01, 1e-5, 100.0, "seconds")
    rigid_restitution: float = quantity(0.0, 0.0, 1.0)
    yield_stress: float = quantity(1e4, 1.0, 1e12, "pascals")
    friction_angle: float = quantity(0.6, 0.01, 1.4, "radians")
    critical_compression: float = quantity(0.025, 1e-4, 0.5, "a strain")
    critical_stretch: float = quantity(0.0075, 1e-4, 0.5, "a strain")
    hardening: float = quantity(10.0, 0.0, 30.0)
    bulk_modulus: float = quantity(2e5, 10.0, 1e12, "pascals")
    viscosity: float = quantity(0.0, 0.0, 1e5, "Pa s")
    fibre_modulus: float = quantity(0.0, 0.0, 1e12, "pascals")
    fibre_axis: tuple[float, float, float] = (0.0, 0.0, 1.0)

    def __post_init__(self) -> None:
        require(self.law in LAWS, "material.law", self.law, f"choose one of {', '.join(LAWS)}")
        require(self.density > 0, "material.density", self.density, "give kg/m³ above 0 and up to 30000")
        require_quantities(self, "material.")
        require(
            finite(*self.fibre_axis) and abs(math.hypot(*self.fibre_axis) - 1.0) < 1e-3,
            "material.fibre_axis",
            self.fibre_axis,
            "give a unit vector",
        )


PRESET_FOLDER = Path(__file__).resolve().parents[2] / "presets" / "materials"
MAX_PRESET_BYTES = 64 * 2**10
MAX_PRESETS = 500
"""Files read from one preset folder at most."""

_RESERVED = DEVICES | {"custom"}
"""``custom`` stands for no preset."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class PresetFolder:
    """Presets of one folder: ``good`` by name, and the error of each of the ``broken``.

    descriptions: of the good ones; may be empty.
    """

    good: dict[str, Material] = dataclasses.field(default_factory=dict)
    descriptions: dict[str, str] = dataclasses.field(default_factory=dict)
    broken: dict[str, str] = dataclasses.field(default_factory=dict)


def preset_names() -> list[str]:
    """Return the sorted names of all shipped presets."""
    return sorted(path.stem for path in PRESET_FOLDER.glob("*.toml"))


def load_preset(name: str) -> Material:
    """Return the shipped preset ``name``. Raises InputError when it does not exist."""
    if name not in preset_names():
        raise InputError(f"material preset {name!r}: unknown name; choose one of {', '.join(preset_names())}")
    return _read_preset(PRESET_FOLDER / f"{name}.toml")[0]


def read_presets(folder: Path) -> PresetFolder:
    """Return all presets in ``folder``, sorted by name; none if the folder is missing.

    Unusable files are listed under ``broken`` and do not affect the others.
    """
    found = PresetFolder()
    try:
        paths = sorted(itertools.islice((p for p in folder.glob("*.toml") if not p.name.startswith(".")), MAX_PRESETS))
    except OSError:
        return found
    for path in paths:
        name = unicodedata.normalize("NFC", path.stem)
        try:
            check_preset_name(name)
            material, description = _read_preset(path)
        except InputError as error:
            found.broken[name] = str(error)
        else:
            found.good[name], found.descriptions[name] = material, description
    return found


def check_preset_name(name: str) -> None:
    """Raise InputError unless ``name`` is a valid file name on every system."""
    good = 0 < len(name) <= 48 and name == name.strip() and may_be_named(name)
    if not good:
        raise InputError(f"preset name {name!r}: use up to 48 letters, digits, spaces, '_' and '-'")
    if name.casefold() in _RESERVED:
        raise InputError(f"preset name {name!r}: is reserved by the system; choose another")


def save_preset(folder: Path, name: str, material: Material, description: str = "") -> Path:
    """Write ``material`` as a user preset, replacing one of the same name, and return its path.

    Raises InputError for an invalid name, a shipped preset's name, or a folder that cannot be written.
    """
    name = unicodedata.normalize("NFC", name)
    check_preset_name(name)
    if name.casefold() in (shipped.casefold() for shipped in preset_names()):
        raise InputError(f"preset name {name!r}: is a shipped preset; choose another")
    values = dataclasses.asdict(material)
    del values["preset"]
    lines = [f"{key} = {_toml(value)}" for key, value in {"description": description, **values}.items()]
    path = folder / f"{name}.toml"
    with replacing(path) as partial:
        partial.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path


def delete_preset(folder: Path, name: str) -> None:
    """Delete the user preset ``name``, which may be broken. Raises InputError if it is missing or cannot be deleted."""
    for path in folder.glob("*.toml"):
        if unicodedata.normalize("NFC", path.stem) == name:
            try:
                path.unlink()
            except OSError as error:
                raise InputError(f"{path}: cannot be deleted ({error.strerror or error})") from error
            return
    raise InputError(f"{folder}: holds no preset {name!r}; it may already be deleted")


def _read_preset(path: Path) -> tuple[Material, str]:
    try:
        data = read_toml(path, MAX_PRESET_BYTES, what="material preset")
    except FileNotFoundError:
        raise InputError(f"{path}: there is no such file; choose another preset") from None
    description = data.pop("description", "")
    data.pop("source", None)
    data.pop("preset", None)
    return dataclasses.replace(parse(Material, data, str(path)), preset=path.stem), str(description)[:500]


def _toml(value: float | str | tuple[float, ...]) -> str:
    if isinstance(value, tuple):
        return f"[{', '.join(_toml(number) for number in value)}]"
    # A JSON string is a TOML string except for DEL, which JSON does not escape.
    return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007F") if isinstance(value, str) else repr(value)
