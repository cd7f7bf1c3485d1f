# SPDX-License-Identifier: MIT
"""Which way a picture becomes likelier: score distillation."""
