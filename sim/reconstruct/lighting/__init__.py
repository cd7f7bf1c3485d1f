# SPDX-License-Identifier: MIT
"""Cast shadows, the environment and the sun of a photo."""
