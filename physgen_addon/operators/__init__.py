# SPDX-License-Identifier: GPL-3.0-or-later
"""Buttons: check, build a request, call one use case, report."""
