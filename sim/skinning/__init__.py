# SPDX-License-Identifier: MIT
"""Particles carry mesh vertices."""
