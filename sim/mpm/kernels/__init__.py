# SPDX-License-Identifier: MIT
"""Taichi kernels of the engine: grid, particles, contact of particles, time stepping.

substep.py             a substep: the kernels in sequence; time_stepping.py how long it is
kernel_arrays.py       bundles of arrays, with units and shapes; kernel_bundles.py kernels that take them
layout.py              columns of flat rows, constants
runtime.py             Taichi started once; lanes.py threads that share a block, on a card
sorting.py             particles into blocks; parallel_sorting.py the same on a card
broad_phase.py         blocks that can touch something; windows.py nodes that a block reads and writes
particle_transfer.py   particles to grid and back; whole_transfer.py in whole numbers; interpolation.py B-splines
constitutive_response.py  stress by the laws of ``sim/constitutive``
grid.py                the grid's update
particle_contact.py    contact at particles; contact_law.py its law, collider_distance.py distances
deformable_contact.py  contact at nodes; body_faces.py faces there, surface_shares.py how far they are,
                       particle_pairs.py where nodes fail, adhesion.py
crowding.py            volume of fluids; fluid_room.py what ground and bodies leave them
implicit_step.py       implicit steps; implicit_contact.py what touches in them
"""
