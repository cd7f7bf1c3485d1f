# SPDX-License-Identifier: GPL-3.0-or-later
"""Operators: what buttons and menus do.

quick_ops.py           menus and keys where artists look; asset_ops.py samples and the asset library
photo_ops.py           a photo and boxes in it; photo_object_ops.py finds its objects, strokes over them
mask_horizon_ops.py    painted masks, and the horizon
reconstruct_ops.py     photo → scene
import_ops.py          scene folders, PhysGen3D folders, splats
body_ops.py            what takes part, its motion, pins, presets; world_ops.py effects, ground, frames
bake_ops.py            bake; bake_cache_ops.py free and relink bakes
render_ops.py          into the photo; farm_ops.py on a farm; export_ops.py to other programs
diagnose_ops.py        captures and their diagnosis; effect_ops.py adds what that found
compose_ops.py         objects brought to fit each other
install_ops.py         the Python that simulates
"""
