# SPDX-License-Identifier: MIT
"""Gaussian splats, and objects composed out of them (PhyCAGE); docs/composition.md is the overview.

splats.py         the splat object: data, affine maps, deformation with particles
mesh_to_splats.py splats sampled on a textured mesh
splat_ply.py      3DGS PLY files in several dialects; ply_format.py the PLY format itself
views/            posed images with masks and labels, their visual hull and its segmentation
raster/           differentiable rasteriser (Taichi)
image_loss.py     photometric losses and their gradients
splat_fit.py      splats fitted to views by Adam; pair_fit.py two objects at once
guidance/         score distillation: gradients that make a render more likely
compose/          Algorithm 1 of PhyCAGE: optimisation with the simulator, penetration, stability"""
