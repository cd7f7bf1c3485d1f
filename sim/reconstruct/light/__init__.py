# SPDX-License-Identifier: MIT
"""The environment and the sun that explain the photo's shadows."""
