# SPDX-License-Identifier: GPL-3.0-or-later
"""Properties stored by PhysGen: in the scene, hence saved and undone, and in the preferences."""
