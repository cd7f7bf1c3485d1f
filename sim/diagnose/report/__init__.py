# SPDX-License-Identifier: MIT
"""The report of a diagnosis: a self-contained HTML page with SVG figures.

diagnosis_page.py      the page; number_format.py how it shows numbers
effect_words.py        labels and meanings of effects
wording.py             sentences on a verdict; assumptions.py on the nominal model
diagnosis_figures.py   which pictures there are; diagnosis_charts.py bars and bands
trajectory_plots.py    paths over time; object_heatmaps.py where an object is off, drawn by mesh_raster.py
"""

from .diagnosis_page import write_report
from .number_format import parameter_text

__all__ = ["parameter_text", "write_report"]
