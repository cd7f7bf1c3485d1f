# SPDX-License-Identifier: MIT
"""Segmentation: masks of objects, their occlusion order, and amodal completion."""
