# SPDX-License-Identifier: GPL-3.0-or-later
"""Job file → variants → plan of tasks."""
