# SPDX-License-Identifier: MIT
"""In the TRELLIS environment and folder: trellis_driver.py CROP.png FOLDER, writes sample.glb and sample.ply.

Weights: the folder TRELLIS-image-large in the present one, else those that its authors' hub name finds in the cache.
"""

import sys
from pathlib import Path

sys.path.insert(0, str(Path.cwd()))

from PIL import Image
from trellis.pipelines import TrellisImageTo3DPipeline
from trellis.utils import postprocessing_utils

crop, folder = sys.argv[1], Path(sys.argv[2])
weights = Path("TRELLIS-image-large")
pipeline = TrellisImageTo3DPipeline.from_pretrained(
    str(weights) if weights.is_dir() else "microsoft/TRELLIS-image-large"
)
pipeline.cuda()
found = pipeline.run(Image.open(crop), seed=1)
mesh = postprocessing_utils.to_glb(found["gaussian"][0], found["mesh"][0], simplify=0.95, texture_size=1024)
mesh.export(str(folder / "sample.glb"))
found["gaussian"][0].save_ply(str(folder / "sample.ply"))
