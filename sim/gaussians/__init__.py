# SPDX-License-Identifier: MIT
"""Compositional assets out of Gaussian splats and meshes (PhyCAGE); docs/compositional-assets.md is the way in.

splats.py        what a splat object is
sample.py        splats on a mesh, in its colours
ply/             3DGS PLY files in and out
views/           pictures of an object from all around: cameras, masks, the hull that they leave, whose each point is
raster/          pictures from splats and their gradients (Taichi)
fit/             splats from pictures: losses, descent
guidance/        score distillation: which way a picture becomes likelier
physics/         the simulator as an optimiser: points moved by MPM beside a surface; penetration; staying together
compose/         Algorithm 1 and its ablations
moving.py        splats that follow particles
"""
