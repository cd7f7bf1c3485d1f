# SPDX-License-Identifier: MIT
"""Pictures from splats, and the gradients of a loss on them (Taichi)."""
