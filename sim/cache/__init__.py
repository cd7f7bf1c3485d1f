# SPDX-License-Identifier: MIT
"""Bake folders: point caches, the manifest, checkpoints.

bake_folder.py         a folder and its manifest
pc2.py                 point caches; packed_cache.py packed, point_prediction.py by prediction
torn_skin_file.py      torn skins
bake_check.py          whether a bake's files are what was written
"""
