# SPDX-License-Identifier: MIT
"""The environment that Blender's *Install* makes: by the real pip, from a folder of wheels, nothing downloaded."""

import base64
import hashlib
import subprocess
import sys
import threading
import zipfile

import pytest
from physgen.sim.app import install_worker
from physgen.sim.app.stage_process import own_command, run_stage
from physgen.sim.errors import Cancelled, InputError


def a_wheel(folder, name, version="1.0"):
    """A package of one module that holds its version."""
    folder.mkdir(exist_ok=True)
    info = f"{name}-{version}.dist-info"
    files = {
        f"{name}.py": f"VERSION = '{version}'\n",
        f"{info}/METADATA": f"Metadata-Version: 2.1\nName: {name}\nVersion: {version}\n",
        f"{info}/WHEEL": "Wheel-Version: 1.0\nGenerator: test\nRoot-Is-Purelib: true\nTag: py3-none-any\n",
    }
    record = "".join(
        f"{path},sha256={base64.urlsafe_b64encode(hashlib.sha256(text.encode()).digest()).decode().rstrip('=')},{len(text)}\n"
        for path, text in files.items()
    )
    files[f"{info}/RECORD"] = f"{record}{info}/RECORD,,\n"
    with zipfile.ZipFile(folder / f"{name}-{version}-py3-none-any.whl", "w") as archive:
        for path, text in files.items():
            archive.writestr(path, text)


def install(folder, wheels, *names, cancelled=lambda: False, events=None):
    command = own_command(install_worker.MODULE, str(folder), "--wheels", str(wheels))
    for name in names:
        command += ["--requirement", name]
    return run_stage(command, (events if events is not None else []).append, cancelled)


def test_an_environment_is_made_then_completed_and_a_failure_leaves_what_was_there(tmp_path):
    folder, wheels = tmp_path / "it's here", tmp_path / "wheels"
    a_wheel(wheels, "physgen_first")
    events = []
    done = install(folder, wheels, "physgen_first>=1", events=events)
    python = install_worker.environment_python(folder)
    assert done["python"] == str(python)
    asked = [str(python), "-c", "import physgen_first; print(physgen_first.VERSION)"]
    assert subprocess.run(asked, capture_output=True, text=True, check=True).stdout.strip() == "1.0"
    shares = [event["done"] / event["total"] for event in events if event["event"] == "progress"]
    assert shares == sorted(shares) and shares[0] < shares[-1] < 1.0
    with pytest.raises(InputError, match=r"physgen_second.*Install goes on from here"):
        install(folder, wheels, "physgen_first>=1", "physgen_second")
    a_wheel(wheels, "physgen_second")
    install(folder, wheels, "physgen_first>=1", "physgen_second")
    subprocess.run([str(python), "-c", "import physgen_first, physgen_second"], check=True)


def test_a_folder_with_something_else_in_it_is_left_alone(tmp_path):
    (tmp_path / "thesis.txt").write_text("mine")
    with pytest.raises(InputError, match="holds something else: move it away"):
        install(tmp_path, tmp_path, "physgen_first")
    assert [path.name for path in tmp_path.iterdir()] == ["thesis.txt"]


def test_it_can_be_cancelled(tmp_path):
    stop = threading.Event()

    class Events(list):
        def append(self, event):
            stop.set()

    with pytest.raises(Cancelled):
        install(tmp_path / "env", tmp_path, "physgen_first", cancelled=stop.is_set, events=Events())


def test_only_wheels_are_taken_and_a_folder_of_them_is_the_only_source(tmp_path):
    command = install_worker.pip_command(tmp_path, ["numpy>=1"], tmp_path)
    assert command[command.index("--only-binary") + 1] == ":all:"
    assert "--no-index" in command and "--no-index" not in install_worker.pip_command(tmp_path, ["numpy"], None)
    assert sys.executable not in command
