# SPDX-License-Identifier: MIT
"""Pictures of an object from all around: cameras, masks, the hull that they leave, whose each point is. No Taichi.

view.py         what a view is
transforms.py   a folder with transforms.json → views; save.py the way back
frames.py       what transforms.json says of a picture
multiview.py    pictures of SyncDreamer and Zero123++ → views; orbit.py cameras around an object
pictures.py     picture files within bounds; outside.py masks and labels beside them; backdrop.py masks without any
hull.py         masks and cameras → a closed mesh; carving.py its field, depth.py what a camera sees of a mesh
votes.py        whose each vertex is, by the views that see it
"""
