# SPDX-License-Identifier: MIT
"""Bake folders: point caches, the manifest, checkpoints, the lock.

bake_folder.py         a folder and its manifest
pc2.py                 point caches; packed_cache.py packed, point_prediction.py by prediction
torn_skin_file.py      torn skins
checksums.py           sums of files; bake_check.py whether they hold
folder_lock.py         one writer a folder
"""
