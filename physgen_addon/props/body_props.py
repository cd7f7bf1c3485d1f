# SPDX-License-Identifier: GPL-3.0-or-later
"""Simulation properties of an object: role, surface, material, initial motion, later pushes, pins."""

import bpy
from bpy.props import (
    BoolProperty,
    CollectionProperty,
    EnumProperty,
    FloatProperty,
    IntProperty,
    PointerProperty,
    StringProperty,
)
from mathutils import Vector

from ...sim.scene.model import FactorMap, Ground, SceneObject
from ..playback import splat_clouds
from .generated_properties import from_field, switch
from .material_props import PHYSGEN_PG_material


def _on_friction(self: "Surface", context: bpy.types.Context) -> None:
    # Only upwards and only from here, so that the two can be set in any order.
    if self.static_friction < self.friction:
        self.static_friction = self.friction


class Surface:
    """Mixin of property groups: fields of ``sim.scene.scene_object.SceneObject`` and ``sim.scene.model.Ground``."""

    friction: from_field(
        Ground,
        "friction",
        "Friction",
        "Coefficient of sliding friction: ice 0.03, wood on wood 0.4, rubber 1",
        soft_max=1.5,
        update=_on_friction,
    )
    static_friction: from_field(
        Ground,
        "static_friction",
        "Static Friction",
        "Coefficient of static friction; never below the sliding one",
        default=Ground.friction,
        soft_max=1.5,
    )
    restitution: from_field(
        Ground,
        "restitution",
        "Bounce",
        "Coefficient of restitution: speed after over speed before an impact of rigid objects",
        subtype="FACTOR",
    )


def _is_empty(self: "PHYSGEN_PG_pin", item: bpy.types.Object) -> bool:
    return item.type == "EMPTY"


class PHYSGEN_PG_pin(bpy.types.PropertyGroup):
    """A box that pins the part of the object inside it."""

    box: PointerProperty(
        name="Box",
        description=(
            "Empty of type Cube: the part of the object inside it at the start is held. "
            "Animate the empty to move that part"
        ),
        type=bpy.types.Object,
        poll=_is_empty,
    )


class PHYSGEN_PG_push(bpy.types.PropertyGroup):
    """A later push of the object: the velocity that it has from a frame on."""

    frame: IntProperty(
        name="Frame",
        description="The object is pushed at this frame, and free again after it",
        default=24,
        min=0,
        soft_max=250,
    )
    velocity: from_field(
        SceneObject,
        "velocity",
        "Velocity",
        "Velocity that the push gives to the object as a whole",
        subtype="VELOCITY",
        unit="VELOCITY",
        soft_min=-10.0,
        soft_max=10.0,
    )


def _get_speed(self: "PHYSGEN_PG_body") -> float:
    return Vector(self.velocity).length


def _set_speed(self: "PHYSGEN_PG_body", speed: float) -> None:
    velocity = Vector(self.velocity)
    direction = velocity.normalized() if velocity.length > 0 else Vector((1.0, 0.0, 0.0))
    self.velocity = direction * speed


def _show_splats(self: "PHYSGEN_PG_body", context: bpy.types.Context) -> None:
    splat_clouds.show_as(self.id_data, self.splats_as)


SURFACES = [
    ("GROUND", "The Ground's", "Friction and bounce are the ground's (World > Ground)"),
    ("OWN", "Own", "Friction and bounce of its own"),
]


def _get_surface(self: "PHYSGEN_PG_body") -> int:
    return int(self.own_surface)


def _set_surface(self: "PHYSGEN_PG_body", number: int) -> None:
    self.own_surface = bool(number)


class PHYSGEN_PG_body(Surface, bpy.types.PropertyGroup):
    """Simulation properties of an object; ``Object.physgen``."""

    enabled: BoolProperty(name="In Simulation", description="Simulate this object")
    source: StringProperty(description="Name of the object in the scene folder that it was imported from")
    original: PointerProperty(
        name="Stands In For",
        description="Object whose evaluated mesh this one is; it is shown again when this one is removed",
        type=bpy.types.Object,
    )
    cache: StringProperty(description="Name of the object in its bakes, so that it can be renamed")
    role: from_field(
        SceneObject,
        "role",
        "Role",
        "Role in the simulation",
        items=[
            ("dynamic", "Moves", "Simulated: falls, bounces, deforms"),
            ("collider", "Collider", "Static or animated obstacle that other objects collide with"),
        ],
    )
    material: PointerProperty(type=PHYSGEN_PG_material)
    fill: from_field(SceneObject, "fill", "Solid", "Filled with material; off: a hollow, lighter shell")
    shell_thickness: from_field(
        SceneObject,
        "shell_thickness",
        "Wall",
        "Wall thickness of a hollow object",
        min=0.0,
        soft_max=0.1,
    )
    own_wall: switch("shell_thickness", "Own Wall", "Choose its thickness; off: the thinnest that is resolved", 0.01)
    stiffness_group: StringProperty(
        name="Stiffness Weights",
        description="Vertex group (or attribute) whose weights vary the stiffness across the object",
    )
    stiffness_factor: from_field(
        FactorMap,
        "at_one",
        "Stiffness at 1",
        "Factor on the stiffness where the weight is 1; none where it is 0, geometric in between",
        default=0.1,
        soft_min=0.01,
        soft_max=100.0,
    )
    density_group: StringProperty(
        name="Density Weights",
        description="Vertex group (or attribute) whose weights vary the density across the object",
    )
    density_factor: from_field(
        FactorMap,
        "at_one",
        "Density at 1",
        "Factor on the density where the weight is 1; none where it is 0, geometric in between",
        default=2.0,
        soft_min=0.1,
        soft_max=10.0,
    )
    sandy: BoolProperty(name="Turns to Sand", description="Turn the object into sand")
    sandy_frame: IntProperty(name="From Frame", description="First frame as sand", default=1, min=0, soft_max=250)

    own_surface: BoolProperty(name="Own Surface", description="Use own friction and bounce instead of the ground's")
    surface: EnumProperty(
        name="Friction and Bounce",
        description="Friction and bounce of the ground, or the object's own",
        items=SURFACES,
        get=_get_surface,
        set=_set_surface,
    )
    """Shows ``own_surface``."""
    contact_mode: from_field(
        SceneObject,
        "contact_mode",
        "Contact",
        "Contact with other objects",
        items=[
            ("separate", "Rub", "Slides with friction and can separate"),
            ("slip", "Slip", "Slides without friction and cannot separate"),
            ("sticky", "Stick", "Neither slides nor separates"),
        ],
    )

    splats_as: EnumProperty(
        name="Seen As",
        description="Display of Gaussian splats",
        items=[
            ("ELLIPSOIDS", "Splats", "Soft ellipsoids that deform with the material"),
            ("POINTS", "Points", "Small spheres, fast to draw"),
            ("MESH", "Mesh", "The simulated closed mesh around them"),
        ],
        update=_show_splats,
    )

    velocity: from_field(
        SceneObject,
        "velocity",
        "Velocity",
        "Initial velocity. Drag the arrow in the viewport to change it",
        subtype="VELOCITY",
        unit="VELOCITY",
        soft_min=-10.0,
        soft_max=10.0,
    )
    speed: FloatProperty(
        name="Speed",
        description="Magnitude of the velocity; keeps its direction (X if at rest)",
        min=0.0,
        max=1e4,
        soft_max=10.0,
        unit="VELOCITY",
        get=_get_speed,
        set=_set_speed,
    )
    spin: from_field(
        SceneObject,
        "spin",
        "Spin",
        "Initial angular velocity about the centre of mass, an angle per second: 360° is one turn a second",
        subtype="EULER",
        unit="ROTATION",
        soft_min=-50.0,
        soft_max=50.0,
    )
    start_frame: IntProperty(
        name="Starts at Frame",
        description="Static and without collisions before this frame",
        default=0,
        min=0,
        soft_max=250,
    )
    pushes: CollectionProperty(type=PHYSGEN_PG_push)
    push_index: IntProperty(name="Push", description="Active push")
    waits: switch("start_frame", "Waits", "Starts at a frame of its own; off: with the simulation", 2)
    asleep: from_field(
        SceneObject,
        "asleep",
        "Asleep until Touched",
        "Keeps its pose until something touches it, if it stands and nothing but gravity acts on it",
    )
    held: from_field(
        SceneObject,
        "held",
        "Held",
        "Asleep where nothing carries it, too: it hangs, or leans on something that is not there",
    )
    pins: CollectionProperty(type=PHYSGEN_PG_pin)
    pin_index: IntProperty(name="Pin", description="Active pin")
    goal_stiffness: from_field(
        SceneObject,
        "goal_stiffness",
        "Pull",
        "Stiffness towards the initial shape: acceleration over distance in 1/s²",
        soft_max=1000.0,
    )
    holds_shape: switch(
        "goal_stiffness", "Hold Shape", "Pull it back to its initial shape; off: it stays as it is bent", 100.0
    )
    goal_damping: from_field(
        SceneObject,
        "goal_damping",
        "Hold Damping",
        "Damping of the pull, as a share of critical damping",
        subtype="FACTOR",
    )


def register_body_properties() -> None:
    """Add ``physgen`` to objects."""
    bpy.types.Object.physgen = PointerProperty(type=PHYSGEN_PG_body)


def unregister_body_properties() -> None:
    """Remove it; values stored in files are kept."""
    del bpy.types.Object.physgen


def is_body(item: bpy.types.Object | None) -> bool:
    """Return whether ``item`` is simulated."""
    return item is not None and item.type == "MESH" and item.physgen.enabled


def bodies(scene: bpy.types.Scene) -> list[bpy.types.Object]:
    """Return the simulated objects of ``scene``, sorted by name."""
    return sorted(filter(is_body, scene.objects), key=lambda item: item.name)
