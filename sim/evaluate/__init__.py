# SPDX-License-Identifier: MIT
"""Realism of a video: against a recording, by itself, and by the simulation behind it (docs/evaluation.md).

evaluation.py          results as figures and curves, JSON, tables; report.py their page
footage.py             videos as streams of frames; flow.py flow between two
physics_iq.py          against recordings; physics_iq_folder.py a laboratory's folder of them
no_reference.py        a video by itself; bake_physics.py the simulation behind it
judge_question.py      what a judge is asked; model_judge.py a model as one
questionnaire.py       people as judges; questionnaire_answers.py what they say, questionnaire_report.py its page
"""
