# SPDX-License-Identifier: MIT
"""From the properties that programs write to splats, with a note on all that is taken otherwise than it stands.

Kerbl et al. 2023 store logits of opacities, logarithms of scales, and colours as coefficients of the constant spherical
harmonic, c = 0.5 + Y₀₀ f_dc.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ...errors import InputError
from ..splats import LARGEST_SCALE, LEAST_SCALE, Splats
from .header import Element
from .table import Columns

SH_C0 = 0.28209479177387814
"""Y₀₀ = 1 / (2 √π), the constant spherical harmonic."""

SHARE_DROPPED = 0.01
"""Of a file's splats that may be unusable; more is not an accident of a few."""

CENTRE, SCALE, ROTATION = ("x", "y", "z"), ("scale_0", "scale_1", "scale_2"), ("rot_0", "rot_1", "rot_2", "rot_3")
COLOURS = (
    ("f_dc_0", "f_dc_1", "f_dc_2"),
    ("red", "green", "blue"),
    ("diffuse_red", "diffuse_green", "diffuse_blue"),
    ("r", "g", "b"),
)
OPACITIES = ("opacity", "alpha", "a")
WANTED = frozenset((*CENTRE, *SCALE, *ROTATION, *OPACITIES, *(name for names in COLOURS for name in names)))

_WHOLE = {"u1": 255.0, "u2": 65535.0}
"""Largest value of whole numbers, which stands for 1."""


def require_splats(element: Element, is_mesh: bool, path: Path) -> None:
    """Raise InputError, with what the file is and the way out, unless ``element`` has what makes a splat."""
    have = set(element.types)
    if missing := [name for name in CENTRE if name not in have]:
        raise InputError(f"{path}: its {element.name} element lacks {', '.join(missing)}: give a PLY file of splats")
    if not have & {*SCALE, *ROTATION}:
        kind, remedy = ("a mesh", "sample splats on it") if is_mesh else ("a plain point cloud", "fit splats to it")
        raise InputError(
            f"{path}: holds {kind}, without scale_0…2 and rot_0…3 of splats: {remedy}, or give a PLY file of splats"
        )
    if missing := [name for name in (*SCALE, *ROTATION) if name not in have]:
        raise InputError(
            f"{path}: its splats lack {', '.join(missing)}: export them from the program that made them as a 3DGS PLY "
            "with scale_0…2 and rot_0…3"
        )
    if not any(have.issuperset(names) for names in COLOURS):
        raise InputError(f"{path}: its splats have no colours: export them with f_dc_0…2, or with red, green and blue")


def from_columns(columns: Columns, element: Element, path: Path) -> tuple[Splats, tuple[str, ...]]:
    """The splats of ``columns`` (each (N,)) that ``require_splats`` has passed, and notes. Raises InputError."""
    notes: list[str] = []
    with np.errstate(over="ignore"):
        scales = np.exp(_stacked(columns, SCALE))
    centres, rotations = _stacked(columns, CENTRE), _stacked(columns, ROTATION)
    colours, opacities = _colours(columns, element, path, notes), _opacities(columns, element, path, notes)
    thin = (scales < LEAST_SCALE) & ~np.isnan(scales)
    if thin.any():
        notes.append(f"{int(thin.any(axis=1).sum())} splats thinner than {LEAST_SCALE:g} m were made so thick")
        scales[thin] = LEAST_SCALE
    return _usable(centres, scales, rotations, opacities, colours, path, notes), tuple(notes)


def _stacked(columns: Columns, names: tuple[str, ...]) -> NDArray[np.float64]:
    return np.stack([columns[name] for name in names], axis=1)


def _colours(columns: Columns, element: Element, path: Path, notes: list[str]) -> NDArray[np.float64]:
    names = next(names for names in COLOURS if all(name in columns for name in names))
    values = _stacked(columns, names)
    if names == COLOURS[0]:
        return 0.5 + SH_C0 * values
    notes.append(f"colours were taken from {', '.join(names)}")
    return np.stack([_share(values[:, i], element.types[name], name, path) for i, name in enumerate(names)], axis=1)


def _opacities(columns: Columns, element: Element, path: Path, notes: list[str]) -> NDArray[np.float64]:
    name = next((name for name in OPACITIES if name in columns), None)
    if name is None:
        notes.append("the file has no opacities: every splat was taken as solid")
        return np.ones(len(columns["x"]))
    if name == "opacity" and element.types[name] not in _WHOLE:
        with np.errstate(over="ignore"):
            return np.asarray(1.0 / (1.0 + np.exp(-columns[name])))
    notes.append(f"opacities were taken from {name}")
    return _share(columns[name], element.types[name], name, path)


def _share(values: NDArray[np.float64], kind: str, name: str, path: Path) -> NDArray[np.float64]:
    """``values`` (N,) on a scale where 1 is all."""
    if kind in _WHOLE:
        return values / _WHOLE[kind]
    if kind[0] != "f":
        raise InputError(f"{path}: {name} is kept as {kind}: write it as uchar from 0 to 255, or as float from 0 to 1")
    finite = values[np.isfinite(values)]
    if finite.size and (finite.min() < 0 or finite.max() > 1):
        raise InputError(
            f"{path}: {name} goes from {finite.min():g} to {finite.max():g}: write it as uchar from 0 to 255, or as "
            "float from 0 to 1"
        )
    return values


def _usable(
    centres: NDArray[np.float64],
    scales: NDArray[np.float64],
    rotations: NDArray[np.float64],
    opacities: NDArray[np.float64],
    colours: NDArray[np.float64],
    path: Path,
    notes: list[str],
) -> Splats:
    """The splats without those that are none."""
    with np.errstate(over="ignore", invalid="ignore"):
        lengths = np.linalg.norm(rotations, axis=1)
        reasons = {
            "a centre that is not finite": ~np.isfinite(centres).all(axis=1),
            f"a scale that is no number, or above {LARGEST_SCALE:g} m": ~(scales <= LARGEST_SCALE).all(axis=1),
            "a rotation that is zero or not finite": ~((lengths > 1e-12) & np.isfinite(lengths)),
            "an opacity that is no number": np.isnan(opacities),
            "a colour that is not finite": ~np.isfinite(colours).all(axis=1),
        }
    bad = np.any(list(reasons.values()), axis=0)
    if bad.any():
        first = int(np.flatnonzero(bad)[0])
        what = next(what for what, rows in reasons.items() if rows[first])
        if bad.sum() > SHARE_DROPPED * len(bad):
            raise InputError(
                f"{path}: {int(bad.sum())} of {len(bad)} splats are unusable, the first of them splat {first} with "
                f"{what}: export the file again, or delete such splats"
            )
        notes.append(f"{int(bad.sum())} of {len(bad)} splats were left out, such as splat {first} with {what}")
    good = ~bad
    return Splats(
        centres=centres[good],
        scales=scales[good],
        rotations=rotations[good],
        opacities=opacities[good],
        colours=colours[good],
    )
