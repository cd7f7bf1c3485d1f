# SPDX-License-Identifier: GPL-3.0-or-later
"""The packages of a wheel: the repository's root is ``physgen``, and pyproject.toml cannot prefix what it discovers."""

from setuptools import find_packages, setup

NOT_SHIPPED = ("benchmarks", "examples", "tests")

found = find_packages(exclude=[pattern for name in NOT_SHIPPED for pattern in (name, f"{name}.*")])
# By its name setuptools knows the script, and leaves it out of the package that it lies in.
setup(script_name="setup.py", packages=["physgen", *(f"physgen.{name}" for name in found)])
