# SPDX-License-Identifier: GPL-3.0-or-later
"""The world's ground and the simulation's frames, taken from what is in the scene."""

import bpy

from ..bridge.bounds import rest_bounds
from ..props.body import bodies


class PHYSGEN_OT_ground_below(bpy.types.Operator):
    """Put the ground under the lowest point of all that moves"""

    bl_idname = "physgen.ground_below"
    bl_label = "Put Below the Objects"
    bl_options = {"REGISTER", "UNDO"}  # noqa: RUF012

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Something moves."""
        if not any(item.physgen.role == "dynamic" for item in bodies(context.scene)):
            cls.poll_message_set("Add an object to the simulation first")
            return False
        return True

    def execute(self, context: bpy.types.Context) -> set[str]:
        """A level plane at the height of the lowest corner."""
        moving = [item for item in bodies(context.scene) if item.physgen.role == "dynamic"]
        lowest = min(rest_bounds(item)[0].z for item in moving)
        world = context.scene.physgen.world
        world.use_ground, world.ground_object = True, None
        world.ground_point, world.ground_normal = (0.0, 0.0, lowest), (0.0, 0.0, 1.0)
        return {"FINISHED"}


class PHYSGEN_OT_frames_from_scene(bpy.types.Operator):
    """Simulate the frames that the scene plays"""

    bl_idname = "physgen.frames_from_scene"
    bl_label = "From Scene"
    bl_options = {"REGISTER", "UNDO"}  # noqa: RUF012

    def execute(self, context: bpy.types.Context) -> set[str]:
        """The scene's start and end."""
        scene = context.scene
        simulation = scene.physgen.simulation
        simulation.frame_start, simulation.frame_end = scene.frame_start, scene.frame_end
        return {"FINISHED"}


class PHYSGEN_OT_play_bake_only(bpy.types.Operator):
    """Let the scene's frame range be that of the simulation, so that playback begins again where the bake ends"""

    bl_idname = "physgen.play_bake_only"
    bl_label = "Play Only the Bake"
    bl_options = {"REGISTER", "UNDO"}  # noqa: RUF012

    def execute(self, context: bpy.types.Context) -> set[str]:
        """The simulation's start and end."""
        scene = context.scene
        simulation = scene.physgen.simulation
        scene.frame_start, scene.frame_end = simulation.frame_start, simulation.frame_end
        return {"FINISHED"}


CLASSES = (PHYSGEN_OT_ground_below, PHYSGEN_OT_frames_from_scene, PHYSGEN_OT_play_bake_only)
