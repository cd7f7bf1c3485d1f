# SPDX-License-Identifier: MIT
"""Appearance of objects without the photo's light: albedo, roughness, metallic."""
