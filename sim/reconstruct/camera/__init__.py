# SPDX-License-Identifier: MIT
"""Camera estimation: focal length, pitch, roll, ground, depth maps and scale."""
