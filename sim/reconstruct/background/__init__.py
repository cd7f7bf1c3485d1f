# SPDX-License-Identifier: MIT
"""The photo without its objects."""
