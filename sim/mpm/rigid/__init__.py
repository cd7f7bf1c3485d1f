# SPDX-License-Identifier: MIT
"""Rigid bodies and colliders: shapes, contact, solver, motion."""
