# SPDX-License-Identifier: GPL-3.0-or-later
"""Live preview: a warm worker simulates the scene coarsely after every change, and the viewport plays the result."""
