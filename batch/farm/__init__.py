# SPDX-License-Identifier: GPL-3.0-or-later
"""Many jobs on many machines: ``physgen batch`` (docs/farm.md)."""
