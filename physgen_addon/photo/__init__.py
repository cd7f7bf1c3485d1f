# SPDX-License-Identifier: GPL-3.0-or-later
"""The photo that is reconstructed: image, masks, camera, request."""
