# SPDX-License-Identifier: GPL-3.0-or-later
"""Job files: what they say, what is refused and how, and the tasks that they become."""

import json
import random
import re
import subprocess
import sys
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from physgen.batch.cli import build_parser
from physgen.batch.farm.planning.job_file import MAX_BYTES, load_job
from physgen.batch.farm.planning.task_graph import frame_chunks, make_plan, range_text
from physgen.physgen_addon.frames.frame_index import parse_frame_range
from physgen.sim.errors import InputError
from physgen.sim.scene.camera_path import save_camera_path, swing

HEAD = 'format = "physgen-jobs/1"\nname = "job"\n'
PHOTO = 'photo = "photos/cup.png"\nboxes = [[1, 2, 30, 40]]\n'
SCENE = f'[[scenes]]\nname = "cup"\n{PHOTO}names = ["cup"]\n'


@pytest.fixture
def job(tmp_path):
    """A function that writes a job file beside a photo and loads it."""
    (tmp_path / "photos").mkdir()
    (tmp_path / "photos" / "cup.png").write_bytes(b"any")

    def load(text):
        path = tmp_path / "jobs.toml"
        path.write_bytes(text if isinstance(text, bytes) else text.encode())
        return load_job(path)

    return load


def names(job):
    return [variant.name for variant in job.scenes[0].variants]


def test_a_scene_alone_is_one_variant(job):
    loaded = job(HEAD + SCENE)
    assert names(loaded) == ["base"] and loaded.out == "job"
    assert loaded.scenes[0].frames == tuple(range(1, 49))


def test_every_combination_is_there_once_with_a_name_that_says_what_it_is(job):
    matrix = """
[matrix]
presets = ["soft", ["hard"]]
velocities = [[0, 0, 1], [[-1.5, 0, 2]]]
seeds = [0, 3]
effects = [[], [{ name = "wind", parameters = { wind_x = 6 } }, { name = "air_drag", objects = ["cup"] }]]
"cup.density" = [300, 0.5]
ground.friction = [0.1]
"""
    loaded = job(HEAD + matrix + SCENE)
    found = names(loaded)
    assert len(found) == 32 and len(set(found)) == 32
    assert {"soft-v1-plain-density300-s0", "hard-v2-wind_air_drag-density0_5-s3"} <= set(found)
    last = dict(zip(found, loaded.scenes[0].variants, strict=True))["hard-v2-wind_air_drag-density0_5-s3"].physics
    assert last.presets == ("hard",) and last.velocities == ((-1.5, 0.0, 2.0),) and last.seed == 3
    assert last.settings == ("cup.density=0.5", "ground.friction=0.1")
    wind, drag = last.effects
    assert dict(wind.parameters)["wind_x"] == 6 and dict(wind.parameters)["drag_per_mass"] == 0.05
    assert drag.objects == ("cup",)


def test_a_scene_has_axes_and_variants_of_its_own_over_what_is_common(job):
    text = (
        HEAD
        + "[defaults.bake]\nframes = 10\nfps = 12\n[defaults.render]\nchunk = 4\n"
        + '[matrix]\npresets = ["soft", "hard"]\nseeds = [1, 2]\n'
        + SCENE
        + 'velocities = [0, 0, 1]\nrender = { chunk = 7 }\nmatrix = { presets = ["jelly"] }\n'
        + '[[scenes.variants]]\nname = "slow"\nset = { cup.density = 90 }\n'
    )
    loaded = job(text)
    scene = loaded.scenes[0]
    assert names(loaded) == ["s1", "s2", "slow"]
    assert scene.bake.frames == 10 and scene.bake.fps == 12 and scene.render.chunk == 7
    assert scene.variants[0].physics.presets == ("jelly",)
    assert scene.variants[2].physics.presets == () and scene.variants[2].physics.velocities == ((0.0, 0.0, 1.0),)


def test_the_example_of_the_documentation_works(tmp_path):
    text = (Path(__file__).parents[2] / "docs" / "farm.md").read_text(encoding="utf-8")
    (tmp_path / "coffee.toml").write_text(re.search(r"```toml\n(.*?)```", text, re.S)[1])
    code = re.search(r'python -c "(.*)"', text)[1]
    subprocess.run([sys.executable, "-c", code], cwd=tmp_path, check=True)
    loaded = load_job(tmp_path / "coffee.toml")
    assert names(loaded) == ["jelly-v1", "jelly-v2", "rubber-v1", "rubber-v2", "gale"]
    assert (tmp_path / "coffee.png").stat().st_size > 100_000


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "format is None"),
        ('format = "physgen-jobs/2"', "update PhysGen"),
        (HEAD, "scenes: missing"),
        ("scenes = []\n" + HEAD, "give 1 to 1000"),
        (HEAD + "speed = 3\n" + SCENE, r"speed: unknown field; known are"),
        (HEAD.replace('"job"', '"../job"') + SCENE, "name: is '../job': give a name of letters"),
        (HEAD + 'out = "../x"\n' + SCENE, r"out: file name '../x': must be relative"),
        (HEAD + 'out = "/tmp"\n' + SCENE, r"out: file name '/tmp'"),
        (HEAD + 'out = "."\n' + SCENE, "a separate folder"),
        (HEAD + 'out = "--x"\n' + SCENE, "a separate folder"),
        (HEAD + SCENE + SCENE, r"scenes\[1\].name: 'cup' is used twice"),
        (HEAD + SCENE.replace('"cup"', '"summary"', 1), "'summary': give a name"),
        (HEAD + SCENE + 'scene = "x"', "either photo, with boxes, or scene"),
        (HEAD + '[[scenes]]\nname = "a"\nscene = "x"\nnames = ["cup"]', "names: applies to a photo"),
        (HEAD + '[[scenes]]\nname = "a"\nscene = "x"', "there is no such file"),
        (HEAD + SCENE.replace("cup.png", "mug.png"), "there is no 'photos/mug.png'"),
        (HEAD + SCENE.replace("photos/", "/etc/"), "must be relative"),
        (HEAD + SCENE.replace("[1, 2, 30, 40]", "[1, 2, 30]"), r"boxes\[0\]: expected 4 entries"),
        (HEAD + SCENE + "sizes = [1, 2]", "2 given for 1 boxes"),
        (HEAD + SCENE + 'presets = "sofd"', "material preset 'sofd'"),
        (HEAD + SCENE + "velocities = [[0, 0]]", r"velocities: expected three finite numbers"),
        (HEAD + SCENE + "velocities = [[0,0,1],[0,0,1]]", "velocity: 2 given for 1 objects"),
        (HEAD + SCENE + "velocities = [0, 0, inf]", "three finite numbers"),
        (HEAD + SCENE + "seed = -1", "seed: expected a whole number"),
        (HEAD + SCENE + 'effects = [{ name = "gusts" }]', "effect 'gusts' is unknown"),
        (HEAD + SCENE + 'effects = [{ name = "wind", parameters = { wind_x = 1e9 } }]', "wind_x is 1000000000.0"),
        (HEAD + SCENE + 'effects = [{ name = "wind", objects = ["mug"] }]', "there is no object 'mug'"),
        (HEAD + SCENE + "set = { cup.weight = 3 }", "there is no field 'weight'"),
        (HEAD + SCENE + "set = { density = 3 }", "write OBJECT.FIELD"),
        (HEAD + SCENE + "set = { cup.density = 2020-01-01 }", "set.cup.density: expected numbers"),
        (HEAD + SCENE + "matrix = { seeds = [] }", "matrix.seeds: expected a list with at least one value"),
        (HEAD + SCENE + "matrix = { seeds = [1, 1] }", r"seeds\[1\]: 1 is given twice"),
        (HEAD + SCENE + "matrix = { speeds = [1] }", "matrix.speeds: unknown"),
        (HEAD + SCENE + f"matrix = {{ seeds = {list(range(200))}, cup.density = {list(range(1, 101))} }}", "20000 var"),
        (HEAD + SCENE + "variants = []", "at least one table"),
        (HEAD + SCENE + "variants = [{ seed = 1 }]", "name: is None"),
        (HEAD + SCENE + 'variants = [{ name = "scene" }]', "is 'scene'"),
        (HEAD + SCENE + 'variants = [{ name = "a" }, { name = "A" }]', "two variants are called 'A'"),
        (HEAD + SCENE + 'variants = [{ name = "a", sed = 1 }]', "sed: unknown field"),
        (HEAD + SCENE + "bake = { frames = 0 }", "frames is 0"),
        (HEAD + SCENE + 'bake = { arch = "tpu" }', "choose one of cpu"),
        (HEAD + SCENE + 'bake = { quality = "best" }', "quality 'best'"),
        (HEAD + SCENE + 'bake = { space = "mesh" }', "leave it out"),
        (HEAD + SCENE + "render = { chunk = 0 }", "chunk is 0"),
        (HEAD + SCENE + "render = { samples = 0 }", "samples is 0"),
        (HEAD + SCENE + 'render = { frames = "1-99" }', "frames 1 to 48 are baked"),
        (HEAD + SCENE + 'render = { video = ["gif"] }', "each of mp4, webm, sheet"),
        (HEAD + SCENE + 'render = { engine = "povray" }', "engine: is 'povray': choose one of cycles"),
        (HEAD + SCENE + 'render = { engine = ["cycles"] }', "choose one of cycles"),
        (HEAD + SCENE + "render = { threads = 2 }", "give --threads"),
        (
            HEAD + SCENE + 'render = { camera = "../camera.json" }',
            r"render.camera: file name '../camera.json': must be",
        ),
        (HEAD + SCENE + 'render = { camera = "photos/cup.png" }', r"render.camera: .*cup.png: not readable as JSON"),
        (HEAD + SCENE + 'render = { camera = "photos/cup.png", rise = 2 }', "camera 'photos/cup.png' and rise: give"),
        (HEAD + SCENE + "render = { seed = 2 }", "render.seed: unknown field"),
        (HEAD + "[defaults]\ncook = 1\n" + SCENE, "defaults.cook: unknown field"),
        (HEAD + "a" + ".a" * 200_000 + " = 1\n" + SCENE, "nested too deeply"),
        (HEAD + "x = " + "[" * 50_000, "nested too deeply|not readable"),
        (b"\xff\xfe", "not readable as TOML"),
        (b"#" * (MAX_BYTES + 1), "larger than 1 MiB"),
    ],
)
def test_invalid_job_entries_are_refused_by_name(job, text, words):
    with pytest.raises(InputError, match=words):
        job(text)


ANY = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=8),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=8), inner, max_size=3),
    max_leaves=8,
)
FIELD = st.sampled_from(
    ["presets", "velocities", "spins", "seeds", "effects", "set", "cup.density", "name", "seed", "x"]
)


def toml(value):
    """``value`` as an inline TOML value; what TOML has no word for is a text."""
    if isinstance(value, dict):
        return "{" + ", ".join(f"{json.dumps(k)} = {toml(v)}" for k, v in value.items()) + "}"
    if isinstance(value, list):
        return "[" + ", ".join(map(toml, value)) + "]"
    if isinstance(value, float):
        return {"inf": "inf", "-inf": "-inf", "nan": "nan"}.get(str(value), repr(value))
    return json.dumps(value)


@settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.dictionaries(FIELD, ANY | st.lists(ANY, max_size=3), max_size=3), st.sampled_from(["matrix", "variants", ""]))
def test_any_values_are_read_or_refused(job, table, place):
    body = f"{place} = {toml([table] if place == 'variants' else table)}\n" if place else ""
    body = body or "".join(f"{json.dumps(k)} = {toml(v)}\n" for k, v in table.items() if k != "name")
    try:
        make_plan(job((HEAD + SCENE + body).encode("utf-8", "surrogatepass")))
    except InputError as error:
        assert str(error)


@settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.binary(max_size=60), st.integers(0, 2**32))
def test_damaged_files_are_read_or_refused(job, noise, seed):
    content = bytearray((HEAD + '[matrix]\npresets = ["soft", "hard"]\n' + SCENE).encode())
    at = random.Random(seed).randrange(len(content))
    content[at : at + len(noise) // 2] = noise
    try:
        make_plan(job(bytes(content)))
    except InputError as error:
        assert str(error)


@given(st.lists(st.integers(1, 200), min_size=1, unique=True).map(sorted), st.integers(1, 30))
def test_chunks_are_all_frames_in_order_and_the_command_reads_them(frames, size):
    chunks = frame_chunks(frames, size)
    assert [n for chunk in chunks for n in chunk] == frames and max(map(len, chunks)) <= size
    assert all(parse_frame_range(range_text(chunk), 1, 200) == list(chunk) for chunk in chunks)


def test_the_graph_is_what_the_commands_take(job, ball_scene, tmp_path):
    ball_scene(name="my scene", count=2)
    text = (
        HEAD
        + 'out = "results"\n[defaults.render]\nchunk = 5\nframes = "1-24x2"\nscale = 0.25\nvideo = ["mp4", "sheet"]\n'
        + '[matrix]\nseeds = [0, 1]\nvelocities = [[-1, -1e-7, 0.1]]\neffects = [[{ name = "wind" }]]\n'
        + SCENE.replace('["cup"]', '["-my cup"]')
        + "pitch = -5\nset = { '-my cup.density' = 300 }\n"
        + '[[scenes]]\nname = "balls"\nscene = "my scene"\nbake = { arch = "cuda" }\n'
        + 'render = { format = "exr", engine = "eevee", motion_blur = 0, camera = "photos/path.json" }\n'
    )
    save_camera_path(tmp_path / "photos" / "path.json", swing(first=1, last=24, azimuth_deg=5))
    plan = make_plan(job(text))
    assert plan.out == "results" and plan.root == tmp_path.resolve() and len(plan.meanings) == 4
    seen, ids = {}, set()
    for task in plan.tasks:
        assert task.id not in ids and set(task.needs) <= ids, "those that others need come first"
        ids.add(task.id)
        for name in task.produces:
            assert name.startswith("results/") and name not in seen, "no two tasks write one file"
            seen[name] = task.id
        build_parser().parse_args(task.argv)
        if task.stage == "render":
            balls = task.id.startswith("balls")
            assert {name[-4:] for name in task.produces} == {".exr" if balls else ".png"}
            assert ("photos/path.json" in task.inputs) == ("--camera=photos/path.json" in task.argv) == balls
            assert {"--engine=eevee", "--motion-blur=0.0"} <= set(task.argv) or not balls
    stages = [task.stage for task in plan.tasks]
    assert [stages.count(s) for s in ("reconstruct", "variant", "bake", "render", "encode")] == [1, 4, 4, 12, 8]
    last = plan.tasks[-1]
    assert last.argv[-3:] == ("results/balls/s1/sheet.png", "--fps", "12"), "every second frame is shown twice as long"
    assert last.argv[1:4] == tuple(f"results/balls/s1/frames/{c}" for c in ("0001-0009", "0011-0019", "0021-0023"))
    assert all(task.slots == {"gpu": 1} for task in plan.tasks if task.id.startswith("balls/") and task.stage == "bake")
    reconstruct = build_parser().parse_args(plan.tasks[0].argv)
    assert reconstruct.name == ["-my cup"] and reconstruct.pitch_deg == -5
    varied = build_parser().parse_args(plan.tasks[1].argv)
    assert varied.velocity == [(-1.0, -1e-7, 0.1)] and varied.overrides == ["-my cup.density=300"]
