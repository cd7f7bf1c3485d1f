# SPDX-License-Identifier: MIT
"""Where a simulation and a recording part, which unmodelled effect is the cause, and how far it closes the gap.

``capture`` reads what was observed; ``rigid`` and ``soft`` fit candidate effects to it (``analysis`` is what they
hand over); ``evidence`` weighs the candidates; ``diagnosis`` is what is concluded, as written to disk.
docs/diagnosis.md explains the method.
"""
