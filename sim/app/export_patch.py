# SPDX-License-Identifier: MIT
"""The findings of a diagnosis → a model for MuJoCo (MJCF), or a layer for USD Physics.

The MJCF model is complete: ground and body as captured, with the found effects as MuJoCo's own parameters. USD Physics
knows friction, restitution, gravity, centre of mass and moments of inertia; the rest is kept there as custom data,
and said.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray

from ..diagnose.capture import Capture, CaptureObject
from ..errors import InputError

if TYPE_CHECKING:
    from ..diagnose.rigid.rigid_simulator import RigidBody

Array = NDArray[np.float64]
FORMATS = {"mjcf": "found.xml", "usd": "found.usda"}
"""Format → name of its file in the diagnosis folder."""
RECORDING = ("time_scale", "camera_pose")
"""Effects that correct the recording; a simulator has nothing to change."""
AIR = 1.2
"""Density of air in kg/m³ that drag and lift coefficients refer to."""
PELLET = 0.002
"""Radius in m of the geom that stands for a hidden mass."""


@dataclass(kw_only=True)
class _Settings:
    """The captured model with what was found. Lengths m, per-mass quantities as in docs/simulation.md."""

    gravity: Array
    friction: float
    restitution: float | None
    rolling: float = 0.0
    drag: float = 0.0
    lift: float = 0.0
    wind: Array = field(default_factory=lambda: np.zeros(3))
    weightless: float = 0.0
    pellet: tuple[float, Array] | None = None
    inertia: float = 1.0
    tether: Mapping[str, float] | None = None
    notes: list[str] = field(default_factory=list)


def patch_text(capture: Capture, found: Mapping[str, Mapping[str, float]], kind: str) -> tuple[str, tuple[str, ...]]:
    """Return the text of the file and what it could not say, in sentences.

    found: effect → parameters by name, as ``sim.app.add_effect.found_effects`` returns them. kind: ``mjcf`` or ``usd``.
    Raises InputError for another kind, for more than one object and for a soft one.
    """
    if kind not in FORMATS:
        raise InputError(f"export is {kind!r}: give {' or '.join(FORMATS)}")
    if len(capture.objects) != 1 or not capture.objects[0].belief.rigid:
        raise InputError("export writes one rigid object; this capture has soft or several ones")
    item = capture.objects[0]
    settings = _settings(capture, found)
    text = _mjcf(capture, item, settings) if kind == "mjcf" else _usd(item, settings, found)
    return text, tuple(settings.notes)


def _settings(capture: Capture, found: Mapping[str, Mapping[str, float]]) -> _Settings:
    ground = capture.ground
    out = _Settings(gravity=np.array(capture.gravity), friction=ground.friction, restitution=ground.restitution)
    for name, values in found.items():
        if name == "friction":
            out.friction = values["friction"]
        elif name == "restitution":
            out.restitution = values["restitution"]
        elif name == "rolling_resistance":
            out.rolling = values["lever_arm"]
        elif name == "air_drag":
            out.drag = values["drag_per_mass"]
        elif name == "wind":
            out.drag = values["drag_per_mass"]
            out.wind = np.array([values[f"wind_{axis}"] for axis in "xyz"])
        elif name == "magnus":
            out.lift = values["lift_per_mass"]
        elif name == "buoyancy":
            out.weightless = values["fraction"]
        elif name == "gravity_tilt":
            size, lean, way = float(np.linalg.norm(out.gravity)), values["angle"], values["azimuth"]
            across = math.sin(lean) * np.array([math.cos(way), math.sin(way), 0.0])
            out.gravity = size * (across - np.array([0.0, 0.0, math.cos(lean)]))
        elif name == "mass_offset":
            out.pellet = values["fraction"], np.array([values[f"offset_{axis}"] for axis in "xyz"])
        elif name == "inertia":
            out.inertia = values["factor"]
        elif name == "tether":
            out.tether = values
        elif name in RECORDING:
            out.notes.append(f"{name} corrects the recording, not the simulator")
        else:
            out.notes.append(f"{name} has no counterpart there: {_listed(values)}")
    return out


def _listed(values: Mapping[str, float]) -> str:
    return ", ".join(f"{name} = {value:.6g}" for name, value in values.items())


def _numbers(values: Array | tuple[float, ...] | list[float]) -> str:
    return " ".join(f"{float(v):.9g}" for v in np.ravel(values))


def _add_tether(
    root: ElementTree.Element,
    world: ElementTree.Element,
    body: ElementTree.Element,
    tether: Mapping[str, float],
    mass: float,
) -> None:
    """Tie ``body`` of ``mass`` in kg to a place of ``world``, by a string or a spring."""
    anchor = _numbers([tether[f"anchor_{axis}"] for axis in "xyz"])
    ElementTree.SubElement(world, "site", name="anchor", pos=anchor)
    ElementTree.SubElement(body, "site", name="held", pos="0 0 0")
    tendon = ElementTree.SubElement(root, "tendon")
    length, stiffness = tether["rest_length"], tether["stiffness_per_mass"] * mass
    spring = [0.0 if tether.get("string", 1.0) else length, length]
    line = ElementTree.SubElement(tendon, "spatial", stiffness=f"{stiffness:.9g}", springlength=_numbers(spring))
    for site in ("anchor", "held"):
        ElementTree.SubElement(line, "site", site=site)


def _mjcf(capture: Capture, item: CaptureObject, settings: _Settings) -> str:
    from ..diagnose.rigid.rigid_simulator import CONTACT_TIME, STEPS, damping_ratio, rigid_body

    body = rigid_body(item)
    root = ElementTree.Element("mujoco", model=f"{item.name}_found")
    for note in settings.notes:
        root.append(ElementTree.Comment(f" {note} ".replace("--", "-")))
    ElementTree.SubElement(root, "compiler", angle="radian")
    option = {"gravity": _numbers(settings.gravity), "timestep": f"{CONTACT_TIME / STEPS:.9g}", "cone": "elliptic"}
    if settings.drag or settings.lift:
        option |= {"density": f"{AIR}", "wind": _numbers(settings.wind)}
    ElementTree.SubElement(root, "option", option)
    contact = {"friction": _numbers([settings.friction, 0.0, settings.rolling]), "condim": "6"}
    if settings.restitution is not None:
        # Spring and dashpot of a contact of this half period that leaves with the restitution; solimp near 1, so that
        # MuJoCo does not soften them.
        rate = math.pi / CONTACT_TIME
        damping = 2 * float(damping_ratio(np.array([settings.restitution]))[0]) * rate
        contact |= {"solref": _numbers([-(rate**2), -damping]), "solimp": "0.99 0.99 0.001"}
    shape = {"type": "sphere", "size": f"{body.radius:.9g}"} if body.round else {"type": "mesh", "mesh": item.name}
    if not body.round:
        asset = ElementTree.SubElement(root, "asset")
        points, faces = _numbers(item.vertices), " ".join(map(str, item.faces.ravel()))
        ElementTree.SubElement(asset, "mesh", name=item.name, vertex=points, face=faces)
    world = ElementTree.SubElement(root, "worldbody")
    normal = capture.ground.unit_normal
    plane = {"type": "plane", "size": "0 0 0.1", "pos": _numbers(capture.ground.point), "zaxis": _numbers(normal)}
    ElementTree.SubElement(world, "geom", {"name": "ground", **plane, **contact})
    placed = ElementTree.SubElement(world, "body", name=item.name, pos=_numbers(_start(capture)))
    if settings.weightless:
        placed.set("gravcomp", f"{settings.weightless:.9g}")
    ElementTree.SubElement(placed, "freejoint")
    if settings.inertia != 1.0:
        middle, tensor = _mass_of(body, settings)
        six = [tensor[i, j] for i, j in ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))]
        inertial = {"pos": _numbers(middle), "mass": f"{body.mass:.9g}", "fullinertia": _numbers(six)}
        ElementTree.SubElement(placed, "inertial", inertial)
    mass, fluid = body.mass, {}
    if settings.drag or settings.lift:
        blunt = settings.drag * mass / (AIR * body.area)
        # MuJoCo's drag has no half in it, and its added mass turns a spinning body the other way: half the air's mass.
        magnus = settings.lift * mass / (AIR * body.volume) + 0.5
        fluid = {"fluidshape": "ellipsoid", "fluidcoef": _numbers([blunt, blunt, 0.0, 0.0, magnus])}
    share = settings.pellet[0] if settings.pellet else 0.0
    geom = {"name": item.name, **shape, "mass": f"{(1 - share) * mass:.9g}", **contact, **fluid}
    ElementTree.SubElement(placed, "geom", geom)
    if settings.pellet:
        hidden = {"type": "sphere", "size": f"{PELLET}", "pos": _numbers(settings.pellet[1])}
        hidden |= {"mass": f"{share * mass:.9g}", "contype": "0", "conaffinity": "0"}
        ElementTree.SubElement(placed, "geom", {"name": "hidden_mass", **hidden})
    if settings.tether:
        _add_tether(root, world, placed, settings.tether, mass)
    ElementTree.indent(root)
    return ElementTree.tostring(root, encoding="unicode") + "\n"


def _mass_of(body: RigidBody, settings: _Settings) -> tuple[Array, Array]:
    """Return centre (3,) m and tensor of inertia about it (3, 3) kg m², mesh axes, of the body with what was found."""
    share, place = settings.pellet if settings.pellet else (0.0, np.zeros(3))
    tensor, middle = settings.inertia * body.inertia, body.center + share * place
    tensor = (1.0 - share) * tensor  # of what is not in the pellet
    for part, arm in ((1.0 - share, -share * place), (share, (1.0 - share) * place)):
        tensor = tensor + part * (arm @ arm * np.eye(3) - np.outer(arm, arm))
    return middle, body.mass * tensor


def _start(capture: Capture) -> Array:
    """Return where the body begins (3,) m: at the points of the first frame that saw all of them, else at 0."""
    trial = capture.trials[0]
    if trial.points is None:
        return np.zeros(3)
    whole = np.flatnonzero(np.isfinite(trial.points).all(axis=(1, 2)))
    if len(whole) == 0:
        return np.zeros(3)
    return np.asarray(trial.points[whole[0]].mean(axis=0) - trial.rest_points.mean(axis=0))


def _usd(item: CaptureObject, settings: _Settings, found: Mapping[str, Mapping[str, float]]) -> str:
    said = ("friction", "restitution", "gravity_tilt", "mass_offset", "inertia", *RECORDING)
    data = {f"{name}:{key}": value for name in found if name not in said for key, value in found[name].items()}
    for name in found:
        if name not in said and not any(note.startswith(name) for note in settings.notes):
            settings.notes.append(f"USD Physics has no {name}: kept as custom data of the body")
    size = float(np.linalg.norm(settings.gravity))
    way = settings.gravity / max(size, 1e-12)
    lines = ["#usda 1.0", "(", f'    doc = "Found by PhysGen for {item.name}; compose it over your stage"']
    lines += ['    upAxis = "Z"', "    metersPerUnit = 1", ")", "", 'over "World"', "{"]
    lines += ['    def PhysicsScene "physicsScene"', "    {"]
    lines.append(f"        vector3f physics:gravityDirection = ({way[0]:.9g}, {way[1]:.9g}, {way[2]:.9g})")
    lines += [f"        float physics:gravityMagnitude = {size:.9g}", "    }", ""]
    lines += ['    def Material "found" (', '        prepend apiSchemas = ["PhysicsMaterialAPI"]', "    )", "    {"]
    lines += [f"        float physics:{kind}Friction = {settings.friction:.9g}" for kind in ("static", "dynamic")]
    if settings.restitution is not None:
        lines.append(f"        float physics:restitution = {settings.restitution:.9g}")
    lines += ["    }", "", f'    over "{prim_name(item.name)}" (']
    lines.append('        prepend apiSchemas = ["PhysicsMassAPI", "MaterialBindingAPI"]')
    if data:
        lines += ["        customData = {", "            dictionary physgen = {"]
        lines += [f'                double "{name}" = {value:.9g}' for name, value in data.items()]
        lines += ["            }", "        }"]
    lines += ["    )", "    {", "        rel material:binding:physics = </World/found>"]
    lines.append(f"        float physics:density = {item.belief.density_kg_m3:.9g}")
    if settings.pellet:
        share, place = settings.pellet
        middle = share * place
        lines.append(f"        point3f physics:centerOfMass = ({middle[0]:.9g}, {middle[1]:.9g}, {middle[2]:.9g})")
    if settings.inertia != 1.0:
        from scipy.spatial.transform import Rotation

        from ..diagnose.rigid.rigid_simulator import rigid_body

        _, tensor = _mass_of(rigid_body(item), settings)
        moments, axes = np.linalg.eigh(tensor)
        if np.linalg.det(axes) < 0:
            axes[:, 0] *= -1
        real, *rest = np.roll(Rotation.from_matrix(axes).as_quat(), 1)
        lines.append(f"        float3 physics:diagonalInertia = ({', '.join(f'{m:.9g}' for m in moments)})")
        lines.append(f"        quatf physics:principalAxes = ({real:.9g}, {', '.join(f'{r:.9g}' for r in rest)})")
    return "\n".join([*lines, "    }", "}", ""])


def prim_name(name: str) -> str:
    """Return ``name`` as USD takes it: letters, digits and _, not beginning with a digit."""
    clean = "".join(c if c.isascii() and (c.isalnum() or c == "_") else "_" for c in name) or "body"
    return f"_{clean}" if clean[0].isdigit() else clean
