# SPDX-License-Identifier: GPL-3.0-or-later
"""Rendered frames: their files, index, contact sheets and videos."""
