# SPDX-License-Identifier: GPL-3.0-or-later
"""The verbs of ``physgen``: the flags of each, and what each runs."""
