# SPDX-License-Identifier: GPL-3.0-or-later
"""Batch jobs on one or many machines: ``physgen batch`` (docs/farm.md).

batch_command.py       the verb; ``planning`` makes a plan of a job file
runners.py             who runs a plan: local_runner.py here, dask_runner.py Dask, or a program that it is exported
                       for: slurm_export.py, flamenco_export.py
run_task.py            one task, for programs that run commands; task_execution.py how, task_records.py what it leaves
dask_cluster.py        clusters; dask_worker.py their workers, dask_tasks.py what these run
job_monitor.py         the state of a job
"""
