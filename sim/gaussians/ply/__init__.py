# SPDX-License-Identifier: MIT
"""3DGS PLY files in and out. No Taichi."""
