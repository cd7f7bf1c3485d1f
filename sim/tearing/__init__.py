# SPDX-License-Identifier: MIT
"""Skins that part where their matter parts: blocks of matter and their bonds, and the skin cut along broken bonds."""
