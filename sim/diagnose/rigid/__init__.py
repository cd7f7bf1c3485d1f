# SPDX-License-Identifier: MIT
"""Fits of candidate effects to captures of rigid bodies; the entry point is ``fit_rigid``.

A single rigid body above a plane has a model that is exact in flight and cheap in contact (``rigid_kernel``). It
proposes causes; the particle engine verifies them.

rigid_fits.py          all candidates of a capture, fitted, in order; rigid_candidates.py what they are,
                       world_settings.py what they change, start_numbers.py where their fits begin
rigid_search.py        the search for one effect; pair_search.py for two, rigid_refits.py what is fitted again after
multiple_shooting.py   a fit; shooting_problem.py its residuals and normal equations, segment_paths.py the paths that it
                       simulates, segmented_trial.py trials split at nodes
rigid_kernel.py        the motion of a body above a plane; rigid_simulator.py worlds of it in one launch
observed_poses.py      what a trial observes; quaternions.py
state_tracking.py      initial states and nodes; resting_contact.py of what lies on a face, shared_spins.py of spins
                       that no point shows
contact_uncertainty.py how far a model of contact can be trusted
rigid_misfit.py        whether a fit leaves more than noise; bending.py of a single point in flight
rigid_prediction.py    points predicted by a fit; held_out_score.py scores on what it has not seen
rigid_localisation.py  when and where the missing force acts
"""

from .rigid_fits import RigidFits, fit_rigid

__all__ = ["RigidFits", "fit_rigid"]
