# SPDX-License-Identifier: MIT
"""Pictures of an object from all around: cameras, masks, the hull that they leave, whose each point is. No Taichi."""
