# SPDX-License-Identifier: MIT
"""Decide the material of each object: the user first, then the answer, the names table, the default.

The classes soft, medium and hard are the presets of these names. Their Young's moduli, 5e4, 5e5 and 5e6 Pa, are those
of the paper's simulator and not of real material (PhysGen3D, supplement A.3).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

from ...mpm.surface_contact import friction_from_roughness
from ...scene.material import Material, load_preset
from ...validation import to_json
from ..reconstruct_options import ObjectRequest
from .answer_entries import ObjectAnswer
from .answer_parser import Answers
from .chat_client import ChatRequest
from .material_names import NamedPhysics, NameTable

DEFAULT_PRESET = "medium"

UNIDENTIFIED = {"sphere": DEFAULT_PRESET}
RIGID_PRESET = "wood"
FURRY_PRESET = "plush"
"""Presets of what could not be identified, by the shape of its body. Fruit and balls are round and yield; most else
that stands on a table or a floor keeps its shape in a small fall, and a camera or a book that folds like rubber is not
believed. What has fur and is none of these shapes is a plush toy.
"""

ALIKE = 1.2
"""Largest ratio of widths, and of heights, of unidentified things that are taken to be of the same matter."""

LEAST_MODULUS = {"hard": 1e9, "medium": 1e6}
"""Least Young's modulus of each class in Pa, for real materials. Thresholds lie between foams and cloth, rubber and
soft plastics, and hard plastics, wood, metal (Ashby, Materials Selection in Mechanical Design, chart of modulus and
density).
"""


@dataclass(frozen=True, kw_only=True)
class ObjectPhysics:
    """The physics of one object, and its sources.

    name: its kind, by the user, the answer or the table; None if unknown. preset: material preset with the constitutive
    model and all other parameters. density: kg/m³. youngs_modulus: Pa, of the simulator. fill: whether the whole
    interior is filled. size_m: largest extent in metres, and size_source; None if unknown. roughness: of its surface, 0
    (polished) to 1 (coarse), and friction, the Coulomb coefficient that follows; None uses the ground's. metallic,
    appearance_roughness: of its shader, 0 to 1; None if unknown. source: of the material: "chosen" by the user,
    "asked", "named" in the table, "seen" by its texture, or "default".
    """

    name: str | None
    preset: str
    density: float
    youngs_modulus: float
    fill: bool
    size_m: float | None
    size_source: str
    roughness: float | None
    friction: float | None
    metallic: float | None
    appearance_roughness: float | None
    source: str


def stiffness_of_modulus(youngs_modulus: float) -> str:
    """Return the paper's stiffness class of a real material of ``youngs_modulus`` Pa."""
    return next((name for name, least in LEAST_MODULUS.items() if youngs_modulus >= least), "soft")


def decide_materials(
    requests: Sequence[ObjectRequest], names: Sequence[str | None], answers: Answers | None, table: NameTable
) -> tuple[ObjectPhysics, ...]:
    """Return material and size of each of the ``requests``.

    Priority: the user's preset and size, then ``answers``, then ``table`` by the object's kind, its name in ``names``,
    or the answered name, then the preset "medium", which ``decided_by_shape`` may change. Each missing number comes
    from the next source, except that the numbers of a chosen preset stay as they are. Raises InputError for a preset
    that does not exist.
    """
    given = answers.objects if answers is not None else ()
    decided = []
    for i, (request, name) in enumerate(zip(requests, names, strict=True)):
        answer = given[i] if i < len(given) else ObjectAnswer()
        usual = next((found for word in (request.kind, name, answer.name) if (found := table.find(word))), None)
        decided.append(_decided(request, name, answer, usual))
    return tuple(decided)


def _decided(
    request: ObjectRequest, name: str | None, answer: ObjectAnswer, usual: NamedPhysics | None
) -> ObjectPhysics:
    stiffness = answer.stiffness
    if stiffness is None and answer.youngs_modulus is not None:
        stiffness = stiffness_of_modulus(answer.youngs_modulus)
    density: float | None = None
    if request.preset is not None:
        preset, source = request.preset, "chosen"
    elif stiffness is not None or answer.density is not None:
        preset = stiffness or (usual.preset if usual is not None else DEFAULT_PRESET)
        density, source = answer.density or (usual.density if usual is not None else None), "asked"
    elif usual is not None:
        preset, density, source = usual.preset, usual.density, "named"
    else:
        preset, source = DEFAULT_PRESET, "default"
    material = load_preset(preset)
    fill = answer.fill if answer.fill is not None else usual.fill if usual is not None else True
    sizes = (
        (request.size_m, "chosen"),
        (answer.size_m, "asked"),
        (usual.size_m if usual is not None else None, "named"),
        (None, "default"),
    )
    size_m, size_source = next((size for size in sizes if size[0] is not None), sizes[-1])
    roughness = usual.roughness if usual is not None else None
    return ObjectPhysics(
        name=request.kind or answer.name or (usual.name if usual is not None else None),
        preset=preset,
        density=material.density if density is None else density,
        youngs_modulus=material.youngs_modulus,
        fill=fill,
        size_m=size_m,
        size_source=size_source,
        roughness=roughness,
        friction=None if roughness is None else friction_from_roughness(roughness),
        metallic=usual.metallic if usual is not None else None,
        appearance_roughness=usual.appearance_roughness if usual is not None else None,
        source=source,
    )


def decided_by_shape(physics: ObjectPhysics, shape: str, *, furry: bool = False) -> ObjectPhysics:
    """Return ``physics`` with the preset that suits ``shape`` (``BuiltBody.shape``) if nothing else decided it.

    furry: whether it looks as if it were of fur (``fur.is_furry``), which counts for bodies inflated from outlines.
    """
    if physics.source != "default":
        return physics
    soft = furry and shape == "inflated"
    preset = FURRY_PRESET if soft else UNIDENTIFIED.get(shape, RIGID_PRESET)
    material = load_preset(preset)
    return replace(
        physics,
        preset=preset,
        density=material.density,
        youngs_modulus=material.youngs_modulus,
        source="seen" if soft else physics.source,
    )


def decided_by_shapes(
    physics: Sequence[ObjectPhysics],
    shapes: Sequence[str],
    sizes: Sequence[tuple[float, float]],
    furry: Sequence[bool],
) -> tuple[ObjectPhysics, ...]:
    """Return ``physics`` by ``decided_by_shape``, with one preset for things that are alike.

    A candy seen at its edge or in part is not recognised as round, and would be of wood among others of rubber. Of
    things alike in width and height (``sizes``), those count that nothing else decided; the shape of most of them is
    that of all, round ones first. furry: as of ``decided_by_shape``.
    """
    physics = [
        decided_by_shape(item, shape, furry=True) if fur else item
        for item, shape, fur in zip(physics, shapes, furry, strict=True)
    ]
    unknown = [item.source == "default" for item in physics]
    decided = []
    for index, (item, shape) in enumerate(zip(physics, shapes, strict=True)):
        like = [n for n, free in enumerate(unknown) if free and _alike(sizes[index], sizes[n])]
        counts = {each: sum(shapes[n] == each for n in like) for each in sorted({shapes[n] for n in like})}
        rounds = sum(count for each, count in counts.items() if each in UNIDENTIFIED)
        if counts and 0 < rounds < len(like):
            found = [each for each in counts if (each in UNIDENTIFIED) == (2 * rounds >= len(like))]
            shape = max(found, key=lambda each: counts[each])
        decided.append(decided_by_shape(item, shape))
    return tuple(decided)


def _alike(first: tuple[float, float], second: tuple[float, float]) -> bool:
    return all(max(a, b) <= ALIKE * min(a, b) for a, b in zip(first, second, strict=True))


def to_material(physics: ObjectPhysics) -> Material:
    """Return the material of ``physics``: its preset with its own density and Young's modulus."""
    material = load_preset(physics.preset)
    return replace(material, density=physics.density, youngs_modulus=physics.youngs_modulus)


def ground_friction(answers: Answers | None, default: float) -> float:
    """Return the Coulomb coefficient of the ground: by the answered roughness of the surface, else ``default``.

    The mapping is that of ``SceneObject.roughness`` (docs/simulation.md, "Surfaces").
    """
    if answers is None or answers.roughness is None:
        return default
    return friction_from_roughness(answers.roughness)


def describe_decision(name: str, physics: ObjectPhysics) -> str:
    """Return one line for the user about the object ``name``: the decision and its source."""
    who = {
        "chosen": "as you chose",
        "asked": "by the model's answer",
        "named": f"as usual for {physics.name!r}",
        "seen": "as it looks furry; set its kind or preset if it is not",
        "default": "the default for its shape, as it was not identified; set its kind or preset",
    }[physics.source]
    size = "" if physics.size_m is None else f", {physics.size_m:.3g} m"
    return f"{name}: {physics.preset}, {physics.density:.4g} kg/m³{size}, {who}"


FORMAT = "physgen-physics/1"


def physics_record(
    names: Sequence[str], decided: Sequence[ObjectPhysics], answers: Answers | None, request: ChatRequest | None
) -> dict[str, Any]:
    """Return the content of ``physics.json``: the decision for each name, the endpoint, and its answers.

    Contains neither the key nor the name of its variable, nor a URL's query.
    """
    return {
        "format": FORMAT,
        "objects": {name: to_json(physics) for name, physics in zip(names, decided, strict=True)},
        "asked": None if request is None else {"address": str(request.address), "model": request.model},
        "answers": None if answers is None else to_json(answers),
    }
