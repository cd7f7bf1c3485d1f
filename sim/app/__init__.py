# SPDX-License-Identifier: MIT
"""Use cases: what the command line, Blender and farms ask for. Each reads folders and writes folders."""
