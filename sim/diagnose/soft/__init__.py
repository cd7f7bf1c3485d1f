# SPDX-License-Identifier: MIT
"""Fits of candidate effects to captures of a deformable object; the entry point is ``soft_fits.fit_soft``.

candidate_survey.py    the search over all candidates; soft_candidates.py what they are
flight_fits.py         flights; free_flight.py the state before first contact
contact_search.py      the motion from then on
soft_simulator.py      many simulations at once; body_mesh.py of tetrahedra, element_kernels.py on the device
model_errors.py        what a correct model would still miss
soft_fits.py           the results as ``Fits``
"""
