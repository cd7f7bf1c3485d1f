# SPDX-License-Identifier: GPL-3.0-or-later
"""Blender scenes to scene folders and back."""
