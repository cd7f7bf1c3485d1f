# SPDX-License-Identifier: GPL-3.0-or-later
"""Rendering into the photo: options, engines, Blender scenes, lighting, image finish (docs/rendering.md)."""
