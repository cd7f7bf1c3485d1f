# SPDX-License-Identifier: MIT
"""Camera estimation: focal length, pitch, roll, ground, depth maps and scale.

camera_estimate.py     the estimate from all that there is, and metres
pose_posterior.py      prior and posterior of a pose; vanishing_points.py what straight lines say of it,
                       round_feet.py cups and cans
depth_map.py           depth maps; ground_plane.py the ground in one
ground_camera.py       a camera above the ground z = 0, and places there
"""
