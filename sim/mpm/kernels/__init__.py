# SPDX-License-Identifier: MIT
"""Taichi kernels of the engine: grid, particles, contact of particles, time stepping."""
