# SPDX-License-Identifier: MIT
"""Views of an object from all around: posed images, the visual hull and its segmentation. No Taichi.

posed_images.py       a view: image, camera, mask, labels; image files and orbit cameras
view_files.py         folders with transforms.json, and image grids of SyncDreamer and Zero123++
visual_hull.py        masks and cameras → a closed mesh; silhouettes.py distance fields of masks
hull_segmentation.py  vertex labels by voting over views, and the foreground's closed body
"""
