# SPDX-License-Identifier: MIT
"""Realism of a video: against a recording, by itself, and by the simulation behind it (docs/evaluation.md).

``footage.py`` reads videos, ``physics_iq.py`` compares with recordings, ``evaluation.py`` holds and writes results.
The use case is ``sim/app/evaluate.py``.
"""
