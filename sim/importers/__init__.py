# SPDX-License-Identifier: MIT
"""Files of other programs, one importer a program or format.

physgen3d.py    output folders of PhysGen3D's perception and settings of its simulation; physgen3d_scene.py as a scene
physgen.py      folders of PhysGen, as they are and as a scene folder
splat_scene.py  splat files as a scene folder; mesh_scene.py a mesh file
rigid_models.py models of rigid bodies by their suffix: mjcf.py MuJoCo, urdf.py URDF, rigid_parts.py what both share
masks.py        masks in any supported form; image_masks.py images and arrays (SAM), coco_masks.py JSON (COCO)
recordings.py   tables of measured motion; recorded_files.py C3D and bags, read in a process by recording_worker.py
"""

SPLAT_UP_AXES = ("x", "y", "z", "x-down", "y-down", "z-down")
"""Up axes of splat files; with ``-down``, their down axes. Here, because every command line names them."""
DEFAULT_UP_AXIS = "y-down"
"""Structure-from-motion cameras look along z with y down, and most splat fits keep these axes."""
