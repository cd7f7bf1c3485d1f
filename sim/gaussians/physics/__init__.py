# SPDX-License-Identifier: MIT
"""The simulator as an optimiser's step; docs/compositional-physics.md.

step.py          velocities in, positions out: Algorithm 1, lines 4 to 9 (imports Taichi); options.py its numbers
solid.py         the inside of a mesh or of a skin of points; extension.py from the skin into what fills it
exit_side.py     to which side of an obstacle matter leaves
gradients.py     deformation since the start
carry.py         a mesh carried by a body, and its last touch
penetration.py   how much of one object is inside another
together.py      whether a pair stays together under gravity (imports Taichi)
"""
