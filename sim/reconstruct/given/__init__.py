# SPDX-License-Identifier: MIT
"""A user's own mesh of an object: mended, aligned to the photo, with the photo's colours where it is seen."""
