# SPDX-License-Identifier: MIT
"""Inpainting of the background behind objects and shadows."""
