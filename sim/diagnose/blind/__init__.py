# SPDX-License-Identifier: MIT
"""The program examines itself on data whose causes it is not told (``physgen blind-check``).

Captures come from code that shares nothing with sim/mpm: rigid bodies from MuJoCo, soft ones from finite elements here.
"""

from .check import BlindCheckOptions, blind_check
from .score import BlindScore
from .table import score_table

__all__ = ["BlindCheckOptions", "BlindScore", "blind_check", "score_table"]
