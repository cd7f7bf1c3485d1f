# SPDX-License-Identifier: MIT
"""The report of a diagnosis: a self-contained HTML page with SVG figures."""

from .diagnosis_page import write_report
from .number_format import parameter_text

__all__ = ["parameter_text", "write_report"]
