# SPDX-License-Identifier: GPL-3.0-or-later
"""Batch jobs on one or many machines: ``physgen batch`` (docs/farm.md)."""
