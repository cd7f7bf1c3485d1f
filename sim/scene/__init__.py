# SPDX-License-Identifier: MIT
"""The scene model, its units, its folder on disk and the materials it names."""
