# SPDX-License-Identifier: MIT
"""Rigid bodies and colliders: shapes, contact, solver, motion.

rigid_bodies.py        the way in: bodies of all worlds on the device; rigid_layout.py columns of their arrays,
                       rigid_packing.py their first rows
collision_shapes.py    distance lattices, clusters of contact points
rigid_contact.py       the search for contacts
rigid_solver.py        their impulses, by sweeps; rigid_direct.py all of a world at once
rigid_motion.py        a substep; surface_motion.py of surfaces that deform
rigid_math.py          vectors in flat arrays
"""
