# SPDX-License-Identifier: MIT
"""The simulator as an optimiser: points moved by MPM beside a surface that they cannot pass."""
