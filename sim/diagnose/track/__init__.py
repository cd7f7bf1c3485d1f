# SPDX-License-Identifier: MIT
"""From videos of a scene to a capture: points on the objects' meshes and where each frame shows them.

``tracking`` is the way in; docs/tracking.md explains the method and its limits.
"""
