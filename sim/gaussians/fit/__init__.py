# SPDX-License-Identifier: MIT
"""Splats from pictures."""
