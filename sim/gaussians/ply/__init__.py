# SPDX-License-Identifier: MIT
"""3DGS PLY files in and out. No Taichi.

read.py         a file of any dialect → splats and what was left out of them
write.py        splats → a file as Inria's own program writes it
header.py       which elements and properties a file declares
table.py        the numbers of one element, in bounded memory
dialects.py     properties → splats
compressed.py   SuperSplat's packed properties → splats
"""
