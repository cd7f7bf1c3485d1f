# SPDX-License-Identifier: MIT
"""Composition: several objects brought to fit each other (Algorithm 1 of PhyCAGE and its ablations).

compose_options.py    options and request; no heavy imports
composition_parts.py  parts, reference image, result; a part as a simulated body with its mesh (Taichi)
seating.py            surfaces moved out of others, and seated in them
composition.py        the optimisation (Taichi); composition_loss.py what it lowers
physical_body.py      the simulator as an optimiser's step: velocities in, positions out (Taichi)
deformation_fit.py    how the motion of surface points moves the rest of a body
body_distances.py     signed distances to a body's inside and to obstacles
penetration.py        how much of one object is inside another
pair_stability.py     whether a pair stays together under gravity (Taichi)
"""
