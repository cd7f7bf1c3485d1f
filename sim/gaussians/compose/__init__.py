# SPDX-License-Identifier: MIT
"""Objects that fit each other: Algorithm 1 of PhyCAGE and its ablations."""
