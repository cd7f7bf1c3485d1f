# SPDX-License-Identifier: GPL-3.0-or-later
"""What PhysGen knows of an object: its part in the simulation, its matter, and how it begins.

Every field stands for one of ``sim.scene.object.SceneObject`` or ``sim.scene.matter.Material`` of the same name.
Blender reads the classes' annotations as properties, so they must not be postponed to strings.
"""

import bpy
from bpy.props import (
    BoolProperty,
    CollectionProperty,
    EnumProperty,
    FloatProperty,
    FloatVectorProperty,
    IntProperty,
    PointerProperty,
    StringProperty,
)
from mathutils import Vector

from ..bridge import splats
from .material import PHYSGEN_PG_material
from .surface import Surface


def _is_empty(self: "PHYSGEN_PG_pin", item: bpy.types.Object) -> bool:
    return item.type == "EMPTY"


class PHYSGEN_PG_pin(bpy.types.PropertyGroup):
    """A box that holds what of the object is inside it."""

    box: PointerProperty(
        name="Box",
        description=(
            "An empty of the kind Cube: what of the object is inside it at the start is held. "
            "Animate the empty to move what it holds"
        ),
        type=bpy.types.Object,
        poll=_is_empty,
    )


def _get_speed(self: "PHYSGEN_PG_body") -> float:
    return Vector(self.velocity).length


def _set_speed(self: "PHYSGEN_PG_body", speed: float) -> None:
    velocity = Vector(self.velocity)
    direction = velocity.normalized() if velocity.length > 0 else Vector((1.0, 0.0, 0.0))
    self.velocity = direction * speed


def _show_splats(self: "PHYSGEN_PG_body", context: bpy.types.Context) -> None:
    splats.show_as(self.id_data, self.splats_as)


class PHYSGEN_PG_body(Surface, bpy.types.PropertyGroup):
    """An object's part in the simulation; ``Object.physgen``."""

    enabled: BoolProperty(name="In Simulation", description="Let the object take part in the simulation")
    source: StringProperty(description="Name of the object in the scene folder that it was imported from")
    cache: StringProperty(description="Name of the object in its bakes, so that it can be renamed")
    role: EnumProperty(
        name="Role",
        description="What the object does",
        items=[
            ("dynamic", "Moves", "Falls, bounces, deforms: it is simulated"),
            ("collider", "Collider", "Stays where it is, or goes where its animation takes it, and others hit it"),
        ],
    )
    material: PointerProperty(type=PHYSGEN_PG_material)
    fill: BoolProperty(
        name="Solid", description="Matter all through the inside; off: a hollow shell that weighs less", default=True
    )
    shell_thickness: FloatProperty(
        name="Wall",
        description="Thickness of a hollow object's wall; 0 chooses the thinnest that the quality resolves",
        min=0.0,
        max=1e3,
        soft_max=0.1,
        unit="LENGTH",
    )
    sandy: BoolProperty(name="Turns to Sand", description="Let the object collapse into sand")
    sandy_frame: IntProperty(
        name="From Frame", description="First frame in which it is sand", default=1, min=0, soft_max=250
    )

    own_surface: BoolProperty(
        name="Own Surface", description="Friction and bounce of its own; off: the same as the ground's"
    )
    contact_mode: EnumProperty(
        name="Contact",
        description="How it meets others",
        items=[
            ("separate", "Rub", "Slides with friction, is free to leave"),
            ("slip", "Slip", "Slides without friction and does not leave"),
            ("sticky", "Stick", "Neither slides nor leaves"),
        ],
    )

    splats_as: EnumProperty(
        name="Seen As",
        description="What an object of Gaussian splats is seen as",
        items=[
            ("ELLIPSOIDS", "Splats", "Each splat as a soft ellipsoid, which follows the matter around it"),
            ("POINTS", "Points", "Each splat as a small ball, quick to draw"),
            ("MESH", "Mesh", "The closed mesh around them, which is simulated"),
        ],
        update=_show_splats,
    )

    velocity: FloatVectorProperty(
        name="Velocity",
        description="Velocity at the start. Drag the arrow in the viewport",
        subtype="VELOCITY",
        unit="VELOCITY",
        soft_min=-10.0,
        soft_max=10.0,
    )
    speed: FloatProperty(
        name="Speed",
        description="Length of the velocity; its direction stays. At rest: along X",
        min=0.0,
        max=1e4,
        soft_max=10.0,
        unit="VELOCITY",
        get=_get_speed,
        set=_set_speed,
    )
    spin: FloatVectorProperty(
        name="Spin",
        description="Turning at the start in radians a second about the centre of mass; one turn a second is 6.28",
        subtype="XYZ",
        soft_min=-50.0,
        soft_max=50.0,
    )
    start_frame: IntProperty(
        name="Starts at Frame",
        description="Until then it stays where it is and touches nothing. 0: with the simulation",
        default=0,
        min=0,
        soft_max=250,
    )
    pins: CollectionProperty(type=PHYSGEN_PG_pin)
    pin_index: IntProperty(name="Pin", description="The chosen pin")
    goal_stiffness: FloatProperty(
        name="Hold Shape",
        description="Pull of all its matter back to its place, acceleration over distance in 1/s²; 0 is none",
        min=0.0,
        max=1e6,
        soft_max=1000.0,
    )
    goal_damping: FloatProperty(
        name="Hold Damping",
        description="Share of critical damping of that pull",
        min=0.0,
        max=1.0,
        subtype="FACTOR",
    )


CLASSES = (PHYSGEN_PG_material, PHYSGEN_PG_pin, PHYSGEN_PG_body)


def register() -> None:
    """Let every object have a ``physgen``."""
    bpy.types.Object.physgen = PointerProperty(type=PHYSGEN_PG_body)


def unregister() -> None:
    """Take it away again; what a file has stored stays stored."""
    del bpy.types.Object.physgen


def is_body(item: bpy.types.Object | None) -> bool:
    """Whether ``item`` takes part in the simulation."""
    return item is not None and item.type == "MESH" and item.physgen.enabled


def bodies(scene: bpy.types.Scene) -> list[bpy.types.Object]:
    """The objects of ``scene`` that take part, in the order of their names."""
    return sorted(filter(is_body, scene.objects), key=lambda item: item.name)
