# SPDX-License-Identifier: MIT
"""Fits of candidate effects to captures of rigid bodies.

A single rigid body above a plane has a model that is exact in flight and cheap in contact (``kernel``); it proposes,
and the engine confirms. ``fit_rigid`` is the way in.
"""

from .fits import RigidFits, fit_rigid

__all__ = ["RigidFits", "fit_rigid"]
