# SPDX-License-Identifier: MIT
"""Who decides what an object is made of: the user, then the answer, then the table of names, then the default.

The classes soft, medium and hard are the presets of these names. Their Young's moduli, 5e4, 5e5 and 5e6 Pa, are
those of the paper's simulator and not of real matter (PhysGen3D, supplement A.3).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from ...mpm.contacts import friction_from_roughness
from ...scene.materials import load_preset
from ...scene.matter import Material
from ..options import ObjectRequest
from .answer import Answers
from .by_name import NamedPhysics, NameTable
from .entries import ObjectAnswer

DEFAULT_PRESET = "medium"

LEAST_MODULUS = {"hard": 1e9, "medium": 1e6}
"""Pa, of real matter: from here on it belongs to the class. Chosen between foams and cloth, rubber and soft plastics,
and hard plastics, wood, metal (Ashby, Materials Selection in Mechanical Design, chart of modulus and density)."""


@dataclass(frozen=True, kw_only=True)
class ObjectPhysics:
    """What was decided about one object.

    name: what it is, by the user, the answer or the table; None where nobody knows.
    preset: material preset that gives the law and all that is not named here. density: kg/m³. youngs_modulus: Pa, of
    the simulator. fill: whether matter goes through the whole inside.
    size_m: largest extent in metres, and size_source who says so; None where nobody does.
    roughness: of its surface, 0 (polished) to 1 (coarse), and friction, the Coulomb coefficient that follows; None
    takes the ground's. metallic, appearance_roughness: of its shader, 0 to 1; None where nobody knows.
    source: who says what it is made of: "chosen" by the user, "asked", "named" in the table, or "default".
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
    """The paper's class of real matter of ``youngs_modulus`` Pa."""
    return next((name for name, least in LEAST_MODULUS.items() if youngs_modulus >= least), "soft")


def decide(
    requests: Sequence[ObjectRequest], names: Sequence[str | None], answers: Answers | None, table: NameTable
) -> tuple[ObjectPhysics, ...]:
    """What each of the ``requests`` is made of, and how large it is.

    The user's own preset and size come first, then what ``answers`` say, then what ``table`` says of the object's kind,
    of its name in ``names``, or of the name that was answered, then the preset "medium". Each number that is missing in
    one is taken from the next, but the numbers of a chosen preset stay as they are. Raises InputError for a preset that
    does not exist.
    """
    said = answers.objects if answers is not None else ()
    decided = []
    for i, (request, name) in enumerate(zip(requests, names, strict=True)):
        answer = said[i] if i < len(said) else ObjectAnswer()
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


def to_material(physics: ObjectPhysics) -> Material:
    """The material of ``physics``: its preset with its own density and Young's modulus."""
    material = load_preset(physics.preset)
    return replace(material, density=physics.density, youngs_modulus=physics.youngs_modulus)


def ground_friction(answers: Answers | None, default: float) -> float:
    """Coulomb coefficient of the ground: by the answered roughness of the surface, else ``default``.

    The mapping is the one that ``SceneObject.roughness`` has (docs/simulation.md, "Surfaces").
    """
    if answers is None or answers.roughness is None:
        return default
    return friction_from_roughness(answers.roughness)


def in_words(name: str, physics: ObjectPhysics) -> str:
    """One line for the user about the object ``name``: what was decided, and who said so."""
    who = {
        "chosen": "as you chose",
        "asked": "by the model's answer",
        "named": f"as things called {physics.name!r} usually are",
        "default": "by default, since nothing tells what it is; give its kind or preset",
    }[physics.source]
    size = "" if physics.size_m is None else f", {physics.size_m:.3g} m"
    return f"{name}: {physics.preset}, {physics.density:.4g} kg/m³{size}, {who}"
