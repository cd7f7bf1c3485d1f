# SPDX-License-Identifier: MIT
"""What other programs leave behind, read as it is: PhysGen3D, PhysGen, masks by SAM, COCO annotations."""
