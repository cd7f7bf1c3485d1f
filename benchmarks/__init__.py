# SPDX-License-Identifier: GPL-3.0-or-later
"""Benchmarks: ``python -m physgen.benchmarks`` lists them, ``python -m physgen.benchmarks.NAME`` runs one.

Not part of a wheel or of Blender's extension. What they measured: docs/measurements.md.
"""
