# SPDX-License-Identifier: MIT
"""What the surface of an object is like without the photo's light: albedo, roughness, metallic."""
