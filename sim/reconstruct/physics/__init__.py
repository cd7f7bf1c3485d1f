# SPDX-License-Identifier: MIT
"""What things are made of: asked of a model, looked up in a table, or chosen."""
