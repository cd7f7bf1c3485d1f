# SPDX-License-Identifier: MIT
"""Closed triangle meshes: checks, signed distance, mass, interior sampling. No Taichi.

triangles.py           checks, normals, distances to triangles, subdivision, samples
inside_test.py         what is inside, and what bounds it
mesh_checks.py         whether a surface can be filled or hit
signed_distance.py     lattices of distances
interior_sampling.py   particles in a mesh; mass_properties.py what they weigh
"""
