# SPDX-License-Identifier: MIT
"""Programs in place of stages: real processes that answer, refuse, hang, die, write garbage or too much."""

import contextlib
import json
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest
import trimesh
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from physgen.sim.errors import Cancelled, InputError
from physgen.sim.reconstruct.adapters import resolve
from physgen.sim.reconstruct.adapters.command_file import read_command_file
from PIL import Image

WIDTH, HEIGHT = 40, 30
PIXELS = np.random.default_rng(0).integers(0, 255, (HEIGHT, WIDTH, 3), dtype=np.uint8)
HOLE = np.zeros((HEIGHT, WIDTH), dtype=bool)
HOLE[10:20, 12:30] = True
STAGE_INPUTS = {"segmenter": '"{boxes}"', "inpainter": '"{mask}"', "depth_estimator": "", "mesher": '"{mask}"'}


def adapter(folder, stage, body, *, extra="", arguments=None, cancelled=lambda: False):
    """The stage by a script with ``body``, which finds the files in ``files``, the output last."""
    (folder / "run.py").write_text("import sys, os, json, time\nfiles = sys.argv[1:]\noutput = files[-1]\n" + body)
    between = arguments if arguments is not None else STAGE_INPUTS[stage]
    parts = ", ".join(part for part in ('"{python}", "-I", "{here}/run.py", "{input}"', between, '"{output}"') if part)
    (folder / "adapter.toml").write_text(f'stage = "{stage}"\ncommand = [{parts}]\n{extra}\n')
    return resolve(stage, f"command:{folder / 'adapter.toml'}", cancelled)


COPY_PNG = "import shutil; shutil.copy(files[0], output)"
GREY_PNG = "from PIL import Image; Image.new('RGB', Image.open(files[0]).size, (9, 8, 7)).save(output)"


def test_an_inpainter_fills_the_hole_and_nothing_else(tmp_path):
    fill = adapter(
        tmp_path, "inpainter", GREY_PNG + "; print('a word'); m = Image.open(files[1]); assert m.mode == 'L'"
    )
    before = PIXELS.copy()
    result = fill(PIXELS, HOLE)
    assert (result[HOLE] == (9, 8, 7)).all()
    assert (result[~HOLE] == PIXELS[~HOLE]).all() and (before == PIXELS).all()


def test_a_segmenter_gets_boxes_and_gives_arrays_or_pictures(tmp_path):
    boxes = np.array([[2, 3, 10, 12], [20, 5.5, 38, 28]])
    body = (
        "import numpy as np; from PIL import Image\nw, h = Image.open(files[0]).size\n"
        "masks = np.zeros((2, h, w), bool)\n"
        "for m, (a, b, c, d) in zip(masks, json.load(open(files[1]))): m[int(b):int(d), int(a):int(c)] = True\n"
    )
    expected = np.zeros((2, HEIGHT, WIDTH), dtype=bool)
    expected[0, 3:12, 2:10] = expected[1, 5:28, 20:38] = True
    arrays = adapter(tmp_path, "segmenter", body + "np.save(output, masks)")(PIXELS, boxes)
    assert arrays.dtype == bool and (arrays == expected).all()
    pictures = body + "[Image.fromarray(m).save(os.path.join(output, f'{i}.png')) for i, m in enumerate(masks)]"
    assert (adapter(tmp_path, "segmenter", pictures, extra='output = "masks"')(PIXELS, boxes) == expected).all()


def test_a_depth_with_its_focal_length(tmp_path):
    body = (
        "import numpy as np\nd = np.tile(np.linspace(1, 2, 40), (30, 1)); d[0] = np.inf\n"
        "np.savez(output, depth=d, focal_px=55.5, note=np.array(['text'], dtype=object))"
    )
    depth = adapter(tmp_path, "depth_estimator", body, extra='output = "d.npz"\nmeaning = "metric"')(PIXELS)
    assert depth.meaning == "metric" and depth.focal_px == 55.5
    assert np.isnan(depth.values[0]).all() and np.allclose(depth.values[5], np.linspace(1, 2, 40))


def test_a_mesher_sees_the_object_alone_and_its_files_come_along(tmp_path):
    trimesh.creation.box().export(tmp_path / "box.obj")
    body = (
        "import shutil; from PIL import Image; crop = Image.open(files[0])\n"
        "assert crop.mode == 'RGBA' and crop.width == crop.height and crop.getpixel((0, 0))[3] == 0\n"
        f"assert Image.open(files[1]).size == ({WIDTH}, {HEIGHT})\n"
        f"shutil.copy({str(tmp_path / 'box.obj')!r}, output); open('material.mtl', 'w').write('newmtl a')"
    )
    out = tmp_path / "out"
    out.mkdir()
    path = adapter(tmp_path, "mesher", body, extra='output = "it.obj"', arguments='"{photo}"')(PIXELS, HOLE, out)
    assert path == out / "it.obj" and len(trimesh.load(path).faces) == 12
    assert sorted(p.name for p in out.iterdir()) == ["it.obj", "material.mtl"]


def test_adapter_runs_outside_the_source_tree(tmp_path, monkeypatch):
    monkeypatch.setenv("PYTHONPATH", "/nowhere")
    body = (
        "assert os.getcwd() == os.path.dirname(os.path.realpath(output)), os.getcwd()\n"
        "assert 'PYTHONPATH' not in os.environ and os.environ['WEIGHTS'] == 'a b;$HOME'\n" + GREY_PNG
    )
    fill = adapter(tmp_path, "inpainter", body, extra='[environment]\nWEIGHTS = "a b;$HOME"')
    assert (fill(PIXELS, HOLE)[HOLE] == (9, 8, 7)).all()
    # And the folder with its inputs is gone.
    body = f"open({str(tmp_path / 'was')!r}, 'w').write(os.getcwd())\n" + GREY_PNG
    adapter(tmp_path, "inpainter", body)(PIXELS, HOLE)
    assert not Path((tmp_path / "was").read_text()).exists()


BAD = {
    "dies": ("inpainter", "print('no CUDA device'); sys.exit(7)", "code 7.*no CUDA device"),
    "crashes": ("inpainter", "import signal; os.kill(os.getpid(), signal.SIGKILL)", "code -9.*no output"),
    "writes nothing": ("inpainter", "pass", "wrote no filled.png"),
    "writes garbage": ("inpainter", "open(output, 'wb').write(b'\\x89PNG garbage')", "no readable PNG"),
    "writes a pipe": ("inpainter", "os.mkfifo(output)", "wrote no filled.png"),
    "writes another size": ("inpainter", "from PIL import Image; Image.new('RGB', (31, 41)).save(output)", "31x41"),
    "writes a bomb": (
        "inpainter",
        "import zlib\nfrom struct import pack\n"
        "def c(k, d): return pack('>I', len(d)) + k + d + pack('>I', zlib.crc32(k + d))\n"
        "head = c(b'IHDR', pack('>IIBBBBB', 60000, 60000, 8, 2, 0, 0, 0))\n"
        "body = c(b'IDAT', zlib.compress(bytes(1000))) + c(b'IEND', b'')\n"
        "open(output, 'wb').write(b'\\x89PNG\\r\\n\\x1a\\n' + head + body)",
        "3600000000 pixels",
    ),
    "writes 2 GB": ("inpainter", "open(output, 'wb').truncate(2 * 2**30)", "2147483648 bytes"),
    "writes 2 GB of array": ("depth_estimator", "open(output, 'wb').truncate(2 * 2**30)", "2147483648 bytes"),
    "masks of another shape": (
        "segmenter",
        "import numpy as np; np.save(output, np.ones((1, 5, 5), bool))",
        r"array of \(1, 5, 5\), expected one mask",
    ),
    "an empty mask": (
        "segmenter",
        f"import numpy as np; np.save(output, np.zeros((1, {HEIGHT}, {WIDTH}), bool))",
        "mask 1 of 1 is empty",
    ),
    "pickled masks": (
        "segmenter",
        "import numpy as np; np.save(output, np.array([print], dtype=object))",
        "holds object",
    ),
    "depth that is nothing": (
        "depth_estimator",
        f"import numpy as np; np.save(output, np.full(({HEIGHT}, {WIDTH}), np.nan))",
        "0.0% of the picture",
    ),
    "depth that is flat": (
        "depth_estimator",
        f"import numpy as np; np.save(output, np.full(({HEIGHT}, {WIDTH}), 3.0))",
        "same depth everywhere, 3",
    ),
    "an array that ends": (
        "depth_estimator",
        f"import numpy as np; np.save(output, np.ones(({HEIGHT}, {WIDTH}))); os.truncate(output, 500)",
        "needs 9600",
    ),
    "a mesh of garbage": ("mesher", "open(output, 'wb').write(b'glTF' + bytes(40))", "not a readable mesh"),
    "no mesh": ("mesher", "open(output, 'w').close()", "not a readable mesh"),
}


@pytest.mark.parametrize("what", BAD)
def test_bad_answers_are_named(tmp_path, what):
    stage, body, words = BAD[what]
    call = adapter(tmp_path, stage, body)
    arguments = {
        "segmenter": (PIXELS, np.array([[1.0, 1, 9, 9]])),
        "inpainter": (PIXELS, HOLE),
        "depth_estimator": (PIXELS,),
        "mesher": (PIXELS, HOLE, tmp_path),
    }[stage]
    with pytest.raises(InputError, match=f"(?s)adapter.toml.*{words}"):
        call(*arguments)


GRANDCHILD = (
    "import subprocess\n"
    "child = subprocess.Popen([sys.executable, '-I', '-c', 'import time; time.sleep(600)'])\n"
    "open(os.environ['NOTE'], 'w').write(str(child.pid))\n"
)


def alive(pid):
    """Whether process ``pid`` runs; a zombie that nobody has asked about is dead."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except FileNotFoundError:
        return False


def wait_until(condition):
    end = time.monotonic() + 60
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.02)


@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="asks /proc")
@pytest.mark.parametrize("way", ["time", "cancel", "end"])
def test_nothing_is_left_running(tmp_path, way):
    note = tmp_path / "pid"
    body = GRANDCHILD + (GREY_PNG if way == "end" else "print('waiting', flush=True); time.sleep(600)")
    # Time for the child to start first; how long that takes does not matter.
    limit = f"time_limit_s = {5 if way == 'time' else 600}"
    fill = adapter(
        tmp_path,
        "inpainter",
        body,
        extra=f'{limit}\nenvironment = {{ NOTE = "{note}" }}',
        cancelled=lambda: way == "cancel" and note.exists() and note.read_text() != "",
    )
    if way == "time":
        with pytest.raises(InputError, match=r"(?s)within 5 s.*waiting"):
            fill(PIXELS, HOLE)
    elif way == "cancel":
        with pytest.raises(Cancelled):
            fill(PIXELS, HOLE)
    else:
        assert (fill(PIXELS, HOLE)[HOLE] == (9, 8, 7)).all()
    wait_until(lambda: not alive(int(note.read_text())))


def test_endless_output_is_stopped_and_endless_words_are_cut(tmp_path):
    endless = adapter(tmp_path, "inpainter", "f = open(output, 'wb')\nwhile True: f.write(bytes(2**16)); f.flush()")
    with pytest.raises(InputError, match=r"more than the .* that fit this picture"):
        endless(PIXELS, HOLE)
    talker = adapter(tmp_path, "inpainter", "print('x' * 10**7); print('the end'); sys.exit(3)")
    with pytest.raises(InputError) as caught:
        talker(PIXELS, HOLE)
    assert str(caught.value).endswith("the end") and len(str(caught.value)) < 5000


def test_the_caller_s_other_threads_go_on(tmp_path):
    ticks = []
    stop = threading.Event()
    thread = threading.Thread(target=lambda: [ticks.append(1) for _ in iter(lambda: stop.wait(0.01), True)])
    thread.start()
    adapter(tmp_path, "inpainter", "time.sleep(0.3)\n" + GREY_PNG)(PIXELS, HOLE)
    stop.set()
    thread.join()
    assert len(ticks) > 5


def test_a_program_may_run_in_its_own_folder(tmp_path):
    (tmp_path / "weights").mkdir()
    body = f"assert os.getcwd() == {str((tmp_path / 'weights').resolve())!r}, os.getcwd()\n" + GREY_PNG
    fill = adapter(tmp_path, "inpainter", body, extra='folder = "weights"')
    assert (fill(PIXELS, HOLE)[HOLE] == (9, 8, 7)).all()
    assert list((tmp_path / "weights").iterdir()) == []


FILES = {
    "no folder": ("stage = 'inpainter'\nfolder = 'nope'\ncommand = ['x', '{input}', '{output}']", "folder is 'nope'"),
    "no stage": ("command = ['x', '{input}', '{output}']", "stage is None"),
    "another stage": ("stage = 'mesher'\ncommand = ['x', '{input}', '{output}']", "for the stage mesher"),
    "no command": ("stage = 'inpainter'", "command: expected a list"),
    "a shell line": ("stage = 'inpainter'\ncommand = 'rm -rf {output}'", "command: expected a list"),
    "a strange place": ("stage = 'inpainter'\ncommand = ['x', '{input}', '{outptu}']", "{outptu}; of a inpainter"),
    "no output": ("stage = 'inpainter'\ncommand = ['x', '{input}']", "no {output}"),
    "a misspelt key": (
        "stage = 'inpainter'\ntimelimit = 3\ncommand = ['x', '{input}', '{output}']",
        "timelimit: unkno",
    ),
    "no time": ("stage = 'inpainter'\ntime_limit_s = -1\ncommand = ['x', '{input}', '{output}']", "time_limit_s is -1"),
    "a way out": ("stage = 'inpainter'\noutput = '../x.png'\ncommand = ['x', '{input}', '{output}']", "output is"),
    "another kind": ("stage = 'inpainter'\noutput = 'x.exe'\ncommand = ['x', '{input}', '{output}']", "output is"),
    "numbers": (
        "stage = 'inpainter'\nenvironment = {A = 3}\ncommand = ['x', '{input}', '{output}']",
        "environment:",
    ),
    "no TOML": ("stage = ", "not readable as TOML"),
}


@pytest.mark.parametrize("what", FILES)
def test_mistakes_in_the_file_are_named_before_anything_runs(tmp_path, what):
    text, words = FILES[what]
    (tmp_path / "a.toml").write_text(text)
    with pytest.raises(InputError) as caught:
        resolve("inpainter", f"command:{tmp_path / 'a.toml'}")
    assert words in str(caught.value) and "a.toml" in str(caught.value)


def test_a_program_that_is_not_there(tmp_path):
    (tmp_path / "a.toml").write_text("stage = 'inpainter'\ncommand = ['/nowhere/python', '{input}', '{output}']")
    with pytest.raises(InputError, match="/nowhere/python cannot be started"):
        resolve("inpainter", f"command:{tmp_path / 'a.toml'}")(PIXELS, HOLE)
    with pytest.raises(InputError, match="no such file"):
        resolve("inpainter", f"command:{tmp_path / 'b.toml'}")


@settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    st.dictionaries(
        st.sampled_from(["stage", "command", "output", "time_limit_s", "environment", "meaning", "x"]),
        st.one_of(
            st.text(max_size=8),
            st.integers(),
            st.booleans(),
            st.sampled_from(["inpainter", "a.png", "metric"]),
            st.lists(st.sampled_from(["{input}", "{output}", "{mask}", "{}", "{nope}", "x"]), max_size=4),
            st.dictionaries(st.text("ab=", max_size=2), st.text(max_size=2), max_size=2),
        ),
    )
)
def test_any_file_is_refused_or_read(tmp_path, fields):
    def toml(value):
        if isinstance(value, dict):
            return "{" + ", ".join(f"{json.dumps(k)} = {toml(v)}" for k, v in value.items()) + "}"
        return json.dumps(value)

    path = tmp_path / "a.toml"
    path.write_text("\n".join(f"{key} = {toml(value)}" for key, value in fields.items()), encoding="utf-8")
    with contextlib.suppress(InputError):
        read = read_command_file(path, "inpainter")
        assert "{output}" in "".join(read.command) and "/" not in read.output


def test_python_is_this_one(tmp_path):
    assert adapter(tmp_path, "inpainter", f"assert sys.executable == {sys.executable!r}\n" + GREY_PNG)(
        PIXELS, HOLE
    ).any()


def test_pictures_arrive_as_they_are(tmp_path):
    result = adapter(
        tmp_path, "inpainter", f"import shutil; shutil.copy(files[0], {str(tmp_path / 'in.png')!r}); {COPY_PNG}"
    )
    assert (result(PIXELS, HOLE) == PIXELS).all()
    assert (np.asarray(Image.open(tmp_path / "in.png")) == PIXELS).all()
