# SPDX-License-Identifier: MIT
"""Inpainting of the background behind objects and shadows.

background_inpainting.py  the hole, surface by surface; unboxed_things.py things that stay
surface_edges.py       edges between surfaces; outline_tracing.py their way behind the hole
method_choice.py       the method, by trial; inpainting_methods.py what there is
surface_inpainting.py  a stationary surface; texture_prediction.py by kriging, stretch_inpainting.py by large copies
top_view.py            the ground from above; lattice_pattern.py a pattern of it that repeats
relit_ground.py        ground in shadow lit again; piecewise_light.py light with a few steps
"""
