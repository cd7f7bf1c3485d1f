# SPDX-License-Identifier: MIT
"""Image formation without Blender: how rendered layers and the photo become one frame (docs/rendering.md)."""
