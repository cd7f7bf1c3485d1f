# SPDX-License-Identifier: MIT
"""Point tracking in videos of a scene: points on the objects' meshes and their pixels in every frame, as a capture.

The entry point is ``track_videos``; docs/diagnosis.md explains the method and its limits.
"""
