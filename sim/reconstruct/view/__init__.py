# SPDX-License-Identifier: MIT
"""Where the camera was: focal length, horizon, ground, depth, scale."""
