# SPDX-License-Identifier: MIT
"""The shadows that objects cast, and the holes that they leave together."""
