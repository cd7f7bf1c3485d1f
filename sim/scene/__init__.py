# SPDX-License-Identifier: MIT
"""The scene model, scene folders on disk, materials, meshes and camera paths.

model.py               what a scene holds; scene_object.py its objects, material.py what they are made of
folder.py              scene folders: load, check, hash, save; scene_output.py writes one with all its files
overrides.py           ``cup.density=300``
bake_quality.py        how finely a scene is simulated
units.py               metres and the engine's lengths
meshes.py              mesh files as they are simulated; textured_mesh.py as they look, glb.py their format
shading.py             the photo's light in a texture
environment.py         environment maps; equirectangular.py their directions and solid angles
camera_path.py         moves of the camera
"""
