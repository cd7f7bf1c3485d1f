# SPDX-License-Identifier: MIT
"""Blind check of the diagnosis on generated captures with withheld labels (``physgen blind-check``).

An optional package: nothing else imports it, and the Blender extension leaves it out. Its simulators share no code with
the engine or the fits: rigid bodies in MuJoCo, soft ones in finite elements of its own.
"""

from .check import BlindCheckOptions, blind_check
from .scoring import BlindScore, score_table

__all__ = ["BlindCheckOptions", "BlindScore", "blind_check", "score_table"]
