# SPDX-License-Identifier: MIT
"""Bake folders: point caches, the manifest, checkpoints, the lock."""
