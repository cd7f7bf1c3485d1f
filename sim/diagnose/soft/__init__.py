# SPDX-License-Identifier: MIT
"""Fits of candidate effects to captures of a deformable object; the entry point is ``soft_fits.fit_soft``."""
