# SPDX-License-Identifier: MIT
"""Candidate effects fitted to captures whose object deforms. ``fits.fit_soft`` is the way in."""
