# SPDX-License-Identifier: MIT
"""Commands that may open, write or hold too little, or have no home: one line, nothing lost, nothing left over."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

from .limited_commands import AGAIN, COMMANDS, LIMITS

# 15 CPU seconds together.
pytestmark = [
    pytest.mark.long,
    pytest.mark.skipif(not sys.platform.startswith("linux"), reason="limits of Linux"),
]

SCRIPT = Path(__file__).with_name("limited_commands.py")


CASES = [*((limit, False) for limit in LIMITS), *((limit, True) for limit in AGAIN)]


@pytest.fixture(scope="module")
def lines(tmp_path_factory):
    """What each command did under each limit, by command, limit and whether its result was there."""
    folder = tmp_path_factory.mktemp("limits")
    command = [sys.executable, "-P", str(SCRIPT), str(folder)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=900, check=False)
    assert done.returncode == 0, done.stderr[-3000:]
    found = map(json.loads, done.stdout.splitlines())
    return {(line["command"], line["limit"], line["there"]): line for line in found}


@pytest.mark.parametrize("command", COMMANDS)
@pytest.mark.parametrize(("limit", "there"), CASES)
def test_under_a_limit_a_command_does_all_or_nothing(lines, command, limit, there):
    line = lines[command, limit, there]
    code, said, differs = line["code"], line["said"], line["differs"]
    assert line["scratch"] == []
    if code == 0:
        assert differs["whole"] == [], said
        return
    assert code == 3 and differs["earlier"] == [], (code, said, differs["earlier"])
    errors = [text for text in said.splitlines() if text.startswith("error: ")]
    assert len(errors) == 1 and "Traceback" not in said and ".partial" not in said, said
    if limit.startswith("bytes") and limit != "bytes 0" and not there:
        # The file or folder that has no room.
        assert errors[0].removeprefix("error: ").startswith(RESULTS[command]), errors


RESULTS = {
    "variant": "windy",
    "light": "pair",
    "capture": "captured",
    "questionnaire": "asked",
    "collect": "results",
    "pack": "packed",
    "unpack": "unpacked",
    "export": "moving",
}


def test_what_lacks_memory_is_not_said_to_lack_a_package(lines):
    assert not any("pip install" in line["said"] for line in lines.values())


def test_limits_bite(lines):
    """All would pass where nothing is limited."""
    for limit, least in {"bytes 0": 8, "bytes 600": 8, "bytes 6000": 4, "memory 24": 2}.items():
        assert sum(lines[command, limit, False]["code"] == 3 for command in COMMANDS) >= least, limit
