# SPDX-License-Identifier: MIT
"""Use cases: what the command line, Blender and farms ask for. Each reads folders and writes folders.

reconstruct.py         photo → scene folder; reconstruct_record.py what it was made from
propose.py             photo → objects worth reconstructing, without a box
import_folder.py       folders and files of other programs → scene folder
fit_splats.py          views from all around → scene folder with meshes and splats
add_drops.py           things that fall into a photo
add_effect.py          effects that a diagnosis found, added to a scene
scene_variant.py       the same scene with other physics
set_light.py           another light
compose_scene.py       objects brought to fit each other; compose_inputs.py what that needs,
                       composition_folder.py what it writes
default_motion.py      a motion for a scene at rest; motion_stage.py its moves (moves.py), free_space.py their room
clip_check.py          warnings about a clip before it is rendered
bake.py                scene folder → bake folder
bake_options.py        its options and the hash of its inputs
bake_estimate.py       its cost, and whether objects stay at rest, without running it
bake_run.py            the loop over its frames
bake_samples.py        its contents at each frame
bake_resume.py         checkpoints, and repair of a damaged bake
bake_transfer.py       a bake of Blender's scene for the photo's
pack_bake.py           bakes that travel
simulation.py          the running world of a bake
scene_to_world.py      scene → engine's world: scene_bodies.py bodies, scene_to_world_checks.py checks,
                       matter_maps.py painted stiffness
preview_server.py      the live preview's worker; preview_simulation.py its coarse runs
diagnose.py            capture → diagnosis; explain.py video → diagnosis
import_capture.py      recordings of other programs → capture
export_usd.py          scene and bake → USD: usd_motion.py what moves, usd_particles.py matter
export_patch.py        a diagnosis → MJCF or USD
evaluate.py            how real a video is
stage_process.py       a stage in a process of its own; bake_worker.py, launch.py what runs there
requirements.py        packages that simulating needs; install_worker.py makes an environment with them
"""
