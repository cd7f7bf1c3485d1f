# SPDX-License-Identifier: MIT
"""Models that a user installs: what is known of them, and the folder they lie in (docs/reconstruction.md)."""
