# SPDX-License-Identifier: MIT
"""A user's own mesh of an object: repaired, aligned to the photo, textured by it."""
