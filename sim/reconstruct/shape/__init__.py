# SPDX-License-Identifier: MIT
"""From an outline to a closed body that stands on the ground, with the photo on it."""
