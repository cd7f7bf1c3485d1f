# SPDX-License-Identifier: MIT
"""Files of other programs, one importer a program: PhysGen3D, PhysGen, splat files, masks by SAM and in COCO's format.

physgen3d.py    output folders of PhysGen3D's perception and settings of its simulation, as they are
physgen3d_scene.py  the same as a scene folder
physgen.py      folders of PhysGen, as they are and as a scene folder
splat_scene.py  splat files as a scene folder
masks.py        masks in any supported form; image_masks.py images and arrays (SAM), coco_masks.py JSON (COCO)
"""

SPLAT_UP_AXES = ("x", "y", "z", "x-down", "y-down", "z-down")
"""Up axes of splat files; with ``-down``, their down axes. Here, because every command line names them."""
DEFAULT_UP_AXIS = "y-down"
"""Structure-from-motion cameras look along z with y down, and most splat fits keep these axes."""
