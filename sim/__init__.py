# SPDX-License-Identifier: MIT
"""Reconstruction, simulation, effects, diagnosis and image formation: everything that needs no Blender."""
