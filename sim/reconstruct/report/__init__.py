# SPDX-License-Identifier: MIT
"""The reconstruction, stage by stage, as a page of pictures."""
