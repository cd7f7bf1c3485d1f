# SPDX-License-Identifier: GPL-3.0-or-later
"""Plans as files and as SLURM's arrays; the scripts are run, with a stand-in for SLURM that keeps its rules."""

import dataclasses
import json
import os
import re
import stat
import subprocess
import sys

import pytest
from hypothesis import given
from hypothesis import strategies as st
from physgen.batch.farm.planning.plan import STAGES, Plan, Task, load_plan, save_plan
from physgen.batch.farm.run_task import listed_task, main
from physgen.batch.farm.runners import ClusterOptions, FarmOptions
from physgen.batch.farm.slurm_export import MOST_IN_ARRAY, array_indices, dependency, export_slurm, task_arrays
from physgen.batch.farm.task_records import record_path
from physgen.sim.errors import InputError
from physgen.sim.version import VERSION

FARM = "out of it/.farm"


def a_task(name, stage, *needs, effect="wind", slots=None):
    return Task(id=name, stage=stage, argv=("effects", effect), needs=needs, slots=slots or {}, farm_folder=FARM)


def a_variant(name, first, *, chunks=2):
    bake = f"{name}/bake"
    renders = [a_task(f"{name}/render-{i}", "render", bake, slots={"gpu": 1}) for i in range(chunks)]
    needs = [task.id for task in renders]
    return [
        a_task(f"{name}/variant", "variant", first),
        a_task(bake, "bake", f"{name}/variant"),
        *renders,
        *(a_task(f"{name}/encode-{kind}", "encode", *needs) for kind in ("mp4", "webm")),
    ]


def a_plan(root, *tasks):
    return Plan(name="it's a test", root=root, version=VERSION, tasks=tasks, out="out of it", meanings={"a": "ä"})


def test_a_plan_comes_back_also_where_its_folder_has_moved(tmp_path):
    plan = a_plan(
        tmp_path / "here", a_task("cup/reconstruct", "reconstruct"), *a_variant("cup/weich-1", "cup/reconstruct")
    )
    path = save_plan(plan)
    assert load_plan(path) == plan
    assert save_plan(plan) == path
    assert save_plan(dataclasses.replace(plan, version="0")) != path
    (tmp_path / "here").rename(tmp_path / "there")
    moved = load_plan(tmp_path / "there" / path.relative_to(tmp_path / "here"))
    assert moved == dataclasses.replace(plan, root=tmp_path / "there")


GOOD = {"id": "a", "stage": "bake", "argv": ["effects"]}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"produces": ["../x"]}, "leads out of the job's folder"),
        ({"produces": ["/etc/x"]}, "leads out"),
        ({"inputs": ["C:/x"]}, "leads out"),
        ({"inputs": ["a\\b"]}, "leads out"),
        ({"farm_folder": ".."}, "leads out"),
        ({"id": "../a"}, "is not a valid name"),
        ({"id": "a\nb"}, "is not a valid name"),
        ({"id": "a//b"}, "is not a valid name"),
        ({"stage": "burn"}, "known are"),
        ({"needs": ["b"]}, "is not an earlier task"),
        ({"needs": ["a"]}, "is not an earlier task"),
        ({"argv": []}, "expected 1 to"),
        ({"argv": ["a\0b"]}, "zero bytes"),
        ({"argv": ["models", "install", "isnet", "--yes"]}, "runs 'models' as bake"),
        ({"argv": ["correct", "scene", "--trust"]}, "runs 'correct' as bake"),
        ({"argv": ["bake", "scene", "--packages=x"]}, "'--packages' is no flag"),
        ({"argv": ["bake", "scene", "--arch", "cpu", "-P", "x.py"]}, "'-P' is no flag"),
        ({"argv": ["bake", "/etc", "--out", "b"]}, "must be relative"),
        ({"argv": ["bake", "scene", "--out=../b"]}, "must be relative"),
        ({"stage": "reconstruct", "argv": ["reconstruct", "p.jpg", "--mesher=python:x.py:f"]}, "'--mesher' is no flag"),
        ({"stage": "reconstruct", "argv": ["reconstruct", "p.jpg", "--ask=http://x/v1"]}, "'--ask' is no flag"),
        ({"stage": "reconstruct", "argv": ["reconstruct", "p.jpg", "--depth", "x"]}, "'--depth' is no flag"),
        ({"stage": "render", "argv": ["render", "s", "--camera=../../x.json"]}, "must be relative"),
        ({"slots": [{"name": "gpu", "count": 0}]}, "expected 1 to"),
        ({"shell": "x"}, "unknown field"),
    ],
)
def test_a_plan_that_is_not_ours_is_refused_with_the_field(tmp_path, change, message):
    data = {"format": "physgen-plan/1", "name": "n", "root": "..", "version": VERSION, "tasks": [GOOD | change]}
    path = tmp_path / "plan.json"
    path.write_text(json.dumps(data))
    with pytest.raises(InputError, match=message) as caught:
        load_plan(path)
    assert "plan.json" in str(caught.value)


@pytest.mark.parametrize("root", ["/etc", "../x", "x/..", "", "../" * 40 + ".."])
def test_the_root_is_a_folder_that_the_plan_lies_in(tmp_path, root):
    path = tmp_path / "plan.json"
    path.write_text(json.dumps({"format": "physgen-plan/1", "name": "n", "root": root, "version": "1", "tasks": []}))
    with pytest.raises(InputError, match="root"):
        load_plan(path)


JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=8),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.sampled_from([*GOOD, "needs", "slots"]), inner),
    max_leaves=8,
)


@given(
    st.one_of(
        st.binary(max_size=200),
        JSON.map(lambda value: json.dumps(value).encode()),
        st.fixed_dictionaries(
            {"format": st.just("physgen-plan/1"), "name": JSON, "root": JSON, "version": JSON, "tasks": st.lists(JSON)}
        ).map(lambda value: json.dumps(value).encode()),
        st.lists(st.fixed_dictionaries({"id": JSON, "stage": st.sampled_from(STAGES), "argv": JSON})).map(
            lambda tasks: json.dumps(
                {"format": "physgen-plan/1", "name": "n", "root": "..", "version": "1", "tasks": tasks}
            ).encode()
        ),
    )
)
def test_any_plan_is_read_or_refused(tmp_path_factory, content):
    path = tmp_path_factory.getbasetemp() / "fuzzed.json"
    path.write_bytes(content)
    try:
        plan = load_plan(path)
    except InputError:
        return
    assert path.is_relative_to(plan.root)


@st.composite
def plans(draw):
    tasks = []
    for index in range(draw(st.integers(1, 25))):
        needs = draw(st.sets(st.sampled_from([t.id for t in tasks]), max_size=3)) if tasks else ()
        slots = {"gpu": 1} if draw(st.booleans()) else {}
        tasks.append(a_task(f"t{index}", draw(st.sampled_from(STAGES)), *sorted(needs), slots=slots))
    return tasks


def waits_for(array, arrays, index):
    """Ids that the task ``index`` of ``array`` waits for, as SLURM reads the dependency."""
    text = dependency(array, arrays)
    if text.startswith("aftercorr:"):
        [number] = re.findall(r"\d+", text)
        return {arrays[int(number)].tasks[index]}
    found = set()
    for number, one in re.findall(r"\$\{job\[(\d+)\]\}(?:_(\d+))?", text):
        tasks = arrays[int(number)].tasks
        found |= {tasks[int(one)]} if one else set(tasks.values())
    return found


@given(plans())
def test_every_task_is_in_one_array_and_waits_for_what_it_needs_and_no_more(tasks):
    arrays = task_arrays(tasks)
    placed = {name: (array, index) for array in arrays for index, name in array.tasks.items()}
    assert sum(len(array.tasks) for array in arrays) == len(placed) == len(tasks)
    for task in tasks:
        array, index = placed[task.id]
        assert (array.stage, dict(array.slots)) == (task.stage, dict(task.slots))
        assert waits_for(array, arrays, index) == set(task.needs)
        assert all(placed[need][0].number < array.number for need in task.needs)


def test_arrays_are_few_and_of_the_size_that_slurm_takes():
    many = [a_task("r", "reconstruct")]
    for number in range(1500):
        many += [a_task(f"v{number}", "variant", "r"), a_task(f"b{number}", "bake", f"v{number}")]
    arrays = task_arrays(many)
    assert [(array.stage, len(array.tasks)) for array in arrays] == [
        ("reconstruct", 1),
        ("variant", MOST_IN_ARRAY),
        ("bake", MOST_IN_ARRAY),
        ("variant", 500),
        ("bake", 500),
    ]
    assert [array_indices(array) for array in arrays] == ["0", "0-999", "0-999", "0-499", "0-499"]


STAND_IN = f"""#!{sys.executable}
import json, os, pathlib, sys
queue = pathlib.Path(os.environ["STAND_IN"])
number = len(list(queue.iterdir())) + 100
name = os.path.basename(sys.argv[0])
if name == "sbatch" and str(number) == os.environ["FULL_AT"]:
    sys.exit("no more jobs of yours")
queue.joinpath(f"{{number}}.json").write_text(json.dumps([name, *sys.argv[1:]]))
if name == "sbatch":
    print(f"{{number}};cluster")
"""


def submit(folder, tmp_path, *, full_at=""):
    """Run ``submit.sh``; its exit code, and what it has asked SLURM for: program and arguments by number."""
    tools, queue = tmp_path / "tools", tmp_path / "queue"
    tools.mkdir()
    queue.mkdir()
    for name in ("sbatch", "scontrol", "scancel"):
        (tools / name).write_text(STAND_IN)
        (tools / name).chmod(0o755)
    environment = {**os.environ, "PATH": f"{tools}:{os.environ['PATH']}", "STAND_IN": str(queue), "FULL_AT": full_at}
    done = subprocess.run([folder / "submit.sh"], env=environment, check=False, capture_output=True)
    return done.returncode, {path.stem: json.loads(path.read_text()) for path in sorted(queue.iterdir())}


def run_array(words, ended, root):
    """Run the tasks of one array as SLURM would, one after another; ``ended`` has the good ones, as NUMBER_INDEX."""
    options = dict(word.removeprefix("--").partition("=")[::2] for word in words[1:-2])
    kind, _, rest = options.get("dependency", "afterok:").partition(":")
    wanted = [word for word in rest.split(":") if word]
    first, _, last = options["array"].partition("-")
    for index in range(int(first), int(last or first) + 1):
        needed = {f"{word}_{index}" for word in wanted} if kind == "aftercorr" else set()
        if kind == "afterok":
            needed = {name for word in wanted for name in ([word] if "_" in word else ended["all"][word])}
        if needed <= ended["good"]:
            environment = {**os.environ, "SLURM_ARRAY_TASK_ID": str(index), "SLURM_CPUS_PER_TASK": "1"}
            done = subprocess.run(["bash", *words[-2:]], env=environment, cwd=root, check=False, capture_output=True)
            yield index, done.returncode


def test_the_scripts_carry_out_the_plan_and_a_failure_holds_back_what_needs_it_alone(tmp_path):
    root = tmp_path / "job's $HOME folder"
    root.mkdir()
    tasks = (
        a_task("cup/reconstruct", "reconstruct"),
        a_task("cup/ä 1/variant", "variant", "cup/reconstruct"),
        a_task("cup/b/variant", "variant", "cup/reconstruct", effect="nothing"),
        a_task("cup/ä 1/bake", "bake", "cup/ä 1/variant", slots={"gpu": 1}),
        a_task("cup/b/bake", "bake", "cup/b/variant", slots={"gpu": 1}),
    )
    wanted = ClusterOptions(queue="short", memory="500M", walltime="0:10:00", cores=2, sbatch=("--qos=low",))
    plan = a_plan(root, *tasks)
    for path in export_slurm(plan, FarmOptions(out=tmp_path / "scripts", cluster=wanted, retries=0)):
        if path.suffix in (".sh", ".sbatch"):
            subprocess.run(["bash", "-n", path], check=True)
    assert (tmp_path / "scripts/submit.sh").stat().st_mode & stat.S_IXUSR
    directives = re.findall(r"^#SBATCH (.*)$", (tmp_path / "scripts/bake.sbatch").read_text(), re.MULTILINE)
    assert {"--partition=short", "--mem=500M", "--time=0:10:00", "--cpus-per-task=2", "--qos=low"} < set(directives)

    code, asked = submit(tmp_path / "scripts", tmp_path)
    assert code == 0
    assert [words[0] for words in asked.values()] == ["sbatch", "sbatch", "sbatch", "scontrol"]
    assert "--hold" in asked["100"] and asked["103"] == ["scontrol", "release", "100"]
    assert "--gres=gpu:1" in asked["102"] and "--dependency=aftercorr:101" in asked["102"]
    ended = {"good": set(), "all": {}}
    codes = {}
    for number, words in asked.items():
        if words[0] == "sbatch":
            codes[number] = dict(run_array(words, ended, root))
            ended["all"][number] = [f"{number}_{index}" for index in codes[number]]
            ended["good"] |= {f"{number}_{index}" for index, code in codes[number].items() if code == 0}
    assert codes == {"100": {0: 0}, "101": {0: 0, 1: 3}, "102": {0: 0}}
    assert [record_path(task, root).is_file() for task in tasks] == [True, True, False, True, False]
    # Nothing is done twice.
    [file] = (root / FARM / "plans").glob("*.json")
    assert main([str(file), "cup/reconstruct"]) == 0


def test_partial_submissions_are_cancelled(tmp_path):
    plan = a_plan(tmp_path / "root", a_task("a", "bake"), a_task("b", "render", "a"))
    (tmp_path / "root").mkdir()
    export_slurm(plan, FarmOptions(out=tmp_path / "scripts"))
    code, asked = submit(tmp_path / "scripts", tmp_path, full_at="101")
    assert code == 1
    assert list(asked.values())[1:] == [["scancel", "100"]]


def test_a_number_outside_the_list_is_refused(tmp_path):
    (tmp_path / "list").write_text("a\nb\n")
    assert listed_task(tmp_path / "list", "1") == "b"
    for number in ("2", "-1", "x", "٣", ""):
        with pytest.raises(InputError, match="has no line"):
            listed_task(tmp_path / "list", number)


@pytest.mark.parametrize(
    "change",
    [
        {"queue": "a b"},
        {"account": "x\n#SBATCH --wrap=y"},
        {"walltime": "soon"},
        {"memory": "-1"},
        {"cores": 0},
        {"sbatch": ("-x",)},
        {"sbatch": ("--comment=$(date)",)},
        {"python": "py\nthon"},
    ],
)
def test_values_that_would_break_a_script_are_refused(change):
    with pytest.raises(InputError, match="--"):
        ClusterOptions(**change)
