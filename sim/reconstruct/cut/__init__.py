# SPDX-License-Identifier: MIT
"""Which pixels are the object: outlines, who stands in front, what is hidden."""
