# SPDX-License-Identifier: MIT
"""Children run the code of the tree that starts them, whatever is installed, and find the packages it names."""

import json
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
from physgen.sim.app import requirements
from physgen.sim.app.stage_process import child_environment, own_command

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture
def tree(tmp_path):
    """A tree of another version: the launcher, and a module that says who it is and starts itself once more."""
    app = tmp_path / "träe 2" / "sim" / "app"
    app.mkdir(parents=True)
    for name in ("launch.py", "stage_process.py"):
        (app / name).write_text((ROOT / "sim" / "app" / name).read_text(encoding="utf-8"), encoding="utf-8")
    for name in ("errors.py", "events.py", "memory.py", "processes.py"):
        text = (ROOT / "sim" / name).read_text(encoding="utf-8")
        (app.parent / name).write_text(text, encoding="utf-8")
    for folder in (app, app.parent, app.parent.parent):
        (folder / "__init__.py").touch()
    (app / "who.py").write_text(
        "import os, subprocess, sys, json\n"
        "from .stage_process import own_command\n"
        "try: import only_here\n"
        "except ImportError: only_here = None\n"
        "print(json.dumps([__file__, __package__, os.getcwd(), only_here is not None, sys.argv[1:]]), flush=True)\n"
        "if sys.argv[1:]: sys.exit(subprocess.call(own_command('sim.app.who')))\n",
        encoding="utf-8",
    )
    return app


def launched(tree, *arguments):
    command = [sys.executable, str(tree / "launch.py"), *arguments]
    done = subprocess.run(command, capture_output=True, text=True, env=child_environment(), check=True)
    return [json.loads(line) for line in done.stdout.splitlines()]


def test_the_code_that_runs_is_the_code_that_asked_and_so_for_its_children(tree, tmp_path):
    (tmp_path / "site").mkdir()
    (tmp_path / "site" / "only_here.py").touch()
    first, second = launched(tree, "--packages", str(tmp_path / "site"), "--folder", str(tmp_path), "sim.app.who", "x")
    assert first == [str(tree / "who.py"), "physgen.sim.app", str(tmp_path), True, ["x"]]
    assert second == [str(tree / "who.py"), "physgen.sim.app", str(tmp_path), True, []]


def test_the_packages_of_one_interpreter_are_not_looked_for_unasked(tree):
    assert launched(tree, "sim.app.who")[0][3] is False


def test_modules_beside_the_launcher_hide_no_others(tree):
    (tree / "only_here.py").touch()
    assert launched(tree, "sim.app.who")[0][3] is False


def test_the_command_names_what_differs_only():
    assert own_command("batch.cli", "doctor") == [
        sys.executable,
        str(ROOT / "sim/app/launch.py"),
        "batch.cli",
        "doctor",
    ]


def test_interpreter_check_lists_the_projects_dependencies():
    listed = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["dependencies"]
    wanted = {re.split("[<>=]", item)[0] for item in listed}
    assert {re.split("[<>=]", item)[0] for item in requirements.REQUIREMENTS.values()} == wanted
    oldest = {re.split("[<>=;,]", item)[0]: re.split("[<>=;,]+", item)[1] for item in listed}
    for item in requirements.REQUIREMENTS.values():
        name, least = re.split("[<>=,]+", item)[:2]
        assert least == oldest[name], item


def test_an_interpreter_answers_what_it_lacks():
    complete = subprocess.run(own_command(requirements.MODULE), capture_output=True, text=True, check=True)
    assert json.loads(complete.stdout.splitlines()[-1])["missing"] == []
    # Without site-packages it has the standard library only, and says so rather than failing.
    bare = own_command(requirements.MODULE)
    done = subprocess.run([bare[0], "-I", "-S", *bare[1:]], capture_output=True, text=True, check=True)
    assert json.loads(done.stdout)["missing"] == list(requirements.REQUIREMENTS.values())
