# SPDX-License-Identifier: GPL-3.0-or-later
"""Live preview: a warm worker runs the scene coarsely whenever a number changes, and the viewport plays the result."""
