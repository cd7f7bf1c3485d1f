# SPDX-License-Identifier: MIT
"""A command under limits, on a full disk, without standard streams: one line, and what was there stays as it was."""

import errno
import os
import subprocess
import sys
from pathlib import Path

import pytest
from physgen.batch.terminal import Terminal
from physgen.sim import folder_lock as locks
from physgen.sim.atomic import final_path, replacing, replacing_tree
from physgen.sim.errors import InputError

pytestmark = pytest.mark.skipif(os.name == "nt", reason="shells and signals of POSIX")

TYPED = [sys.executable, "-m", "physgen"]


def typed(words, streams="", **settings):
    """The command ``words``, as a shell starts it with ``streams``: how it ended."""
    line = f'exec "$@" {streams}'
    command = ["sh", "-c", line, "sh", *TYPED, *words]
    return subprocess.run(command, capture_output=True, text=True, timeout=60, check=False, **settings)


@pytest.mark.parametrize(
    ("words", "streams", "code", "said"),
    [
        (["effects", "wind"], "<&- >&-", 0, ""),
        (["effects", "wind"], "<&- >&- 2>&-", 0, ""),
        (["effects", "none such"], "2>&-", 3, ""),
        (["effects", "wind"], ">/dev/full", 3, "error: No space left on device; choose another path, or free space\n"),
        (["effects", "none such"], "2>/dev/full", 3, ""),
    ],
)
def test_streams_that_are_closed_or_full(words, streams, code, said):
    if "/dev/full" in streams and not Path("/dev/full").exists():
        pytest.skip("no such device here")
    done = typed(words, streams)
    assert (done.returncode, done.stderr) == (code, said) and (done.stdout == "" or ">" not in streams[:4])


def test_a_closed_stream_is_no_files_number():
    """What libraries print would otherwise go into the file that was opened next."""
    code = "import os, sys; sys.argv[0] = 'physgen'; import physgen.batch.early_stop; print(os.open(sys.argv[1], 0))"
    line = 'exec "$@" <&- >&-; '
    command = ["sh", "-c", line, "sh", sys.executable, "-c", code.replace("print(", "sys.exit(3 <= "), __file__]
    assert subprocess.run(command, timeout=60, check=False).returncode == 1


@pytest.mark.parametrize(("number", "stops"), [(errno.EPIPE, True), (errno.EIO, True), (errno.ENOSPC, False)])
def test_a_terminal_that_was_closed_means_stop(number, stops, tmp_path):
    with (tmp_path / "log").open("w") as stream:
        terminal = Terminal(as_json=False, out=stream)

        def refuse():
            raise OSError(number, "refused")

        stream.flush = refuse
        if stops:
            terminal.line("words")
        else:
            with pytest.raises(OSError, match="refused"):
                terminal.line("words")
        assert terminal.reader_gone == stops
        del stream.flush


def test_a_disk_that_is_full_keeps_no_lock(tmp_path, monkeypatch):
    def refuse(*_):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(locks.os, "write", refuse)
    for lock in (locks.folder_lock, locks.lock_beside):
        with pytest.raises(InputError, match="free space"), lock(tmp_path / "scene"):
            pass
    assert list(tmp_path.iterdir()) == []


def test_a_message_names_the_file_as_it_would_be_called(tmp_path):
    with (
        pytest.raises(InputError) as refused,
        replacing_tree(tmp_path / "scene") as partial,
        replacing(partial / "pages" / "index.html"),
    ):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
    assert str(refused.value).startswith(f"{tmp_path}/scene/pages/index.html: cannot be written")
    assert final_path(Path("/a/.b/c.partial.png")) == Path("/a/.b/c.partial.png")
