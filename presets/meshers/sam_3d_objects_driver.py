# SPDX-License-Identifier: MIT
"""In the SAM 3D Objects environment and folder: sam_3d_objects_driver.py PHOTO.png MASK.png FOLDER, writes mesh.glb and
splat.ply. Weights: its checkpoints/hf.
"""

import sys
from pathlib import Path

sys.path[:0] = [str(Path.cwd()), str(Path.cwd() / "notebook")]

import numpy as np
from inference import Inference
from PIL import Image

photo, mask, folder = sys.argv[1], sys.argv[2], Path(sys.argv[3])
inference = Inference("checkpoints/hf/pipeline.yaml", compile=False)
found = inference(np.array(Image.open(photo)), np.array(Image.open(mask)) > 127, seed=42)
if found.get("glb") is None:
    sys.exit("it made no mesh of this object")
found["glb"].export(str(folder / "mesh.glb"))
found["gs"].save_ply(str(folder / "splat.ply"))
