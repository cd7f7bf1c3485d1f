# SPDX-License-Identifier: MIT
"""Materials of objects: from a vision-language model, a table of names, or the user."""
