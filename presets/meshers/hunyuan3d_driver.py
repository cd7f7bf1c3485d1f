# SPDX-License-Identifier: MIT
"""In the Hunyuan3D environment and folder: hunyuan3d_driver.py CROP.png FOLDER, writes object.glb.

Version 2.1 has its shape generator in hy3dshape, version 2 in hy3dgen.shapegen. Weights: the folder Hunyuan3D-2.1 or
Hunyuan3D-2 in the present one, else those that its authors' hub name finds in the cache.
"""

import sys
from pathlib import Path

sys.path[:0] = [str(Path.cwd()), str(Path.cwd() / "hy3dshape")]

from PIL import Image

try:
    from hy3dshape.pipelines import Hunyuan3DDiTFlowMatchingPipeline

    name = "Hunyuan3D-2.1"
except ImportError:
    from hy3dgen.shapegen import Hunyuan3DDiTFlowMatchingPipeline

    name = "Hunyuan3D-2"

crop, folder = sys.argv[1], Path(sys.argv[2])
weights = name if Path(name).is_dir() else f"tencent/{name}"
pipeline = Hunyuan3DDiTFlowMatchingPipeline.from_pretrained(weights)
pipeline(image=Image.open(crop).convert("RGBA"))[0].export(str(folder / "object.glb"))
