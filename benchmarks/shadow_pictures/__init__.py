# SPDX-License-Identifier: GPL-3.0-or-later
"""Drawn pictures with exact shadows, without Blender and without end: a second a picture.

plane_shadows.py   exact soft shadows of convex parts on planes
plane_patterns.py  what those planes look like
drawn_picture.py   a picture of things with their shadows, and the share of light that each pixel keeps
"""
