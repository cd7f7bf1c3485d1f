# SPDX-License-Identifier: MIT
"""Image formation without Blender: rendered layers and the photo become one frame (docs/rendering.md)."""
