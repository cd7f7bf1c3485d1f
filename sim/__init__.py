# SPDX-License-Identifier: MIT
"""Reconstruction, simulation, effects, diagnosis and image formation: everything that needs no Blender.

``scene`` holds what is simulated, ``cache`` and ``tearing`` what a bake keeps; ``constitutive``, ``mpm`` and
``effects`` are the physics, ``composite`` makes frames over the photo, ``gaussians`` is splats and composition.
``reconstruct`` makes a scene of a photo, ``importers`` of other programs' files; ``diagnose`` says why a recording
differs, ``evaluate`` how real a video is. ``app`` has the use cases of all of it, and nothing here imports it.
"""
