# SPDX-License-Identifier: MIT
"""The scene model, scene folders on disk, materials, meshes and camera paths."""
