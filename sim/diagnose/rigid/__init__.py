# SPDX-License-Identifier: MIT
"""Fits of candidate effects to captures of rigid bodies; the entry point is ``fit_rigid``.

A single rigid body above a plane has a model that is exact in flight and cheap in contact (``rigid_kernel``). It
proposes causes; the particle engine verifies them.
"""

from .rigid_fits import RigidFits, fit_rigid

__all__ = ["RigidFits", "fit_rigid"]
