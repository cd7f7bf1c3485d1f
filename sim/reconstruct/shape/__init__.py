# SPDX-License-Identifier: MIT
"""From a mask to a closed body that stands on the ground, textured by the photo."""
