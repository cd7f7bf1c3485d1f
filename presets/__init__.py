# SPDX-License-Identifier: MIT
"""Shipped presets as TOML data: ``materials`` and ``qualities``."""
