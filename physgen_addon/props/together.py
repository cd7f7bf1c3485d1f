# SPDX-License-Identifier: GPL-3.0-or-later
"""How objects are fitted together, and what came of it the last time.

Blender reads the classes' annotations as properties, so they must not be postponed to strings.
"""

import bpy
from bpy.props import BoolProperty, CollectionProperty, EnumProperty, FloatProperty, IntProperty, PointerProperty

from ...sim.gaussians.compose.options import ComposeOptions

DEFAULTS = ComposeOptions()


class PHYSGEN_PG_fitted_pair(bpy.types.PropertyGroup):
    """How far one object was in another, before and after; ``name`` says which two."""

    volume_before: FloatProperty()
    """m³ that both take up."""
    volume_after: FloatProperty()
    share_before: FloatProperty()
    """Of the volume of the one that yields, 0 to 1."""
    share_after: FloatProperty()
    deepest_before: FloatProperty()
    """m"""
    deepest_after: FloatProperty()


class PHYSGEN_PG_together(bpy.types.PropertyGroup):
    """Settings and last result of Fit Together; ``Scene.physgen_together``."""

    method: EnumProperty(
        name="Method",
        description="What moves the objects",
        items=[
            ("pse-sds", "Picture and Physics", "The photo says where they belong, physics what can be: PhyCAGE"),
            ("ppps", "Physics", "What passes through is pushed out, and nothing else. Needs no photo"),
            ("sds", "Picture", "The photo alone; they may still pass through each other. To compare"),
            ("ppps+sds", "In Turns", "A step by the photo, a step by physics. To compare"),
        ],
    )
    steps: IntProperty(
        name="Steps",
        description="How often physics (and the photo) have their say; fewer are faster",
        default=DEFAULTS.steps,
        min=1,
        max=100_000,
        soft_max=1000,
    )
    keep_strain: FloatProperty(
        name="Keep Shape",
        description="How much what yields wants its first shape back: 1 like rubber, 0 like dough",
        default=DEFAULTS.keep_strain,
        min=0.0,
        max=1.0,
        subtype="FACTOR",
    )
    keep_original: BoolProperty(
        name="Keep Original",
        description=(
            "Add the shape from before as the shape key 'Before Fit Together': raise its value to dial the change "
            "back, remove it when you are content"
        ),
        default=True,
    )
    pairs: CollectionProperty(type=PHYSGEN_PG_fitted_pair)


CLASSES = (PHYSGEN_PG_fitted_pair, PHYSGEN_PG_together)


def register() -> None:
    """Let every scene have a ``physgen_together``."""
    bpy.types.Scene.physgen_together = PointerProperty(type=PHYSGEN_PG_together)


def unregister() -> None:
    """Take it away again; what a file has stored stays stored."""
    del bpy.types.Scene.physgen_together
