# SPDX-License-Identifier: MIT
"""Sim-to-real diagnosis: where simulation and recording diverge, which unmodelled effect is the cause, gap closed.

``capture`` reads the observations; ``rigid`` and ``soft`` fit candidate effects to them; ``model_comparison`` weighs
the candidates; ``run_diagnosis`` runs all stages; ``diagnosis`` is the result, in memory and on disk.
docs/diagnosis.md explains the method.
"""
