# SPDX-License-Identifier: MIT
"""Closed triangle meshes: checks, signed distance, mass, interior sampling. No Taichi."""
