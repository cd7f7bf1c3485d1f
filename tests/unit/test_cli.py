# SPDX-License-Identifier: GPL-3.0-or-later
"""The command line as a user types it: arguments, exit codes, what is on the disk afterwards."""

import argparse
import io
import json
import re
import signal
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
from physgen.batch import stages
from physgen.batch.cli import build_parser, main
from physgen.batch.terminal import stop_signals
from physgen.sim.app.bake_options import BakeOptions
from physgen.sim.app.bake_worker import BakeJob, job_to_json, run_job
from physgen.sim.cache.bake_folder import disk_usage, load_manifest
from physgen.sim.effects.registry import effects
from physgen.sim.scene.folder import load_scene


def in_a_process(*arguments):
    """Run the command in a process of its own; exit code, events and standard error."""
    command = [sys.executable, "-m", "physgen", *map(str, arguments)]
    result = subprocess.run(command, capture_output=True, text=True, check=False)
    events = [json.loads(line) for line in result.stdout.splitlines() if line.startswith("{")]
    return result.returncode, events, result.stderr


@pytest.fixture
def physgen(capfd):
    """Run the command in this process; exit code, events and standard error."""

    def run(*arguments):
        capfd.readouterr()
        code = main([str(argument) for argument in arguments])
        output, errors = capfd.readouterr()
        return code, [json.loads(line) for line in output.splitlines() if line.startswith("{")], errors

    return run


@pytest.fixture
def photo(tmp_path):
    """An orange disc with a shadow on a grey table."""
    rng = np.random.default_rng(3)
    image = np.clip(rng.normal(150, 6, (240, 320, 3)), 0, 255).astype(np.uint8)
    cv2.ellipse(image, (185, 182), (52, 12), 0, 0, 360, (60, 60, 60), -1)
    cv2.circle(image, (160, 140), 45, (20, 120, 230), -1)
    path = tmp_path / "Foto mit Ümlaut.png"
    path.write_bytes(cv2.imencode(".png", image)[1].tobytes())
    return path


def test_vectors_may_start_with_a_minus():
    from physgen.batch.cli import _keep_negative_vectors

    line = [
        "run",
        "p.jpg",
        "--box",
        "1,2,3,4",
        "--box",
        "5,6,7,8",
        "--velocity",
        "-1,0,.5",
        "-.5,0,2",
        "--preset",
        "soft",
        "hard",
        "--out",
        "v.mp4",
    ]
    options = build_parser().parse_args(_keep_negative_vectors(line))
    assert options.velocity == [(-1.0, 0.0, 0.5), (-0.5, 0.0, 2.0)]
    assert options.box == [(1, 2, 3, 4), (5, 6, 7, 8)] and options.preset == ["soft", "hard"]


@pytest.mark.parametrize(
    "arguments",
    [[], ["run"], ["propose"], ["run", "p.jpg", "--box", "1,2,3", "--out", "v.mp4"], ["dance"],
     ["bake", "s"],
     ["bake", "s", "--out", "b", "--preset", "unobtainium"], ["run", "p.jpg", "--box", "0,0,nan,4", "--out", "v.mp4"]],
)  # fmt: skip
def test_wrong_usage_is_exit_2(arguments, capsys):
    with pytest.raises(SystemExit) as stopped:
        main(arguments)
    assert stopped.value.code == 2
    printed = capsys.readouterr().err
    assert "usage" in printed and "--help" in printed
    # What is wrong is not lost below a list of sixty flags, and is the last line, which farms record.
    assert len(printed.splitlines()) <= 4 and ": error: " in printed.splitlines()[-1]


def test_help_has_every_command_in_a_group_and_every_flag_of_one(capsys):
    for name in ("", "run", "render", "diagnose"):
        with pytest.raises(SystemExit):
            main([*([name] if name else []), "--help"])
        text = capsys.readouterr().out
        parser = build_parser()
        commands = next(a for a in parser._actions if isinstance(a, argparse._SubParsersAction)).choices
        wanted = commands if not name else {f for a in commands[name]._actions for f in a.option_strings}
        assert not [word for word in wanted if not re.search(rf"(^|[ ,]){re.escape(word)}\b", text, re.M)]


def test_a_recording_that_is_called_as_the_photo_is_not_written_over(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "toss.mp4").write_bytes(b"mine")
    assert main(["run", "toss.jpg", "--box", "1,2,3,4"]) == 3
    assert "toss.mp4: is there already, and no earlier run made it" in capsys.readouterr().err
    # Of an earlier run of ours, it is: then the photo is looked for next.
    (tmp_path / "toss_work" / "frames").mkdir(parents=True)
    (tmp_path / "toss_work" / "frames" / "frames.json").write_text("{}")
    assert main(["run", "toss.jpg", "--box", "1,2,3,4"]) == 3
    assert "toss.jpg" in capsys.readouterr().err
    assert (tmp_path / "toss.mp4").read_bytes() == b"mine"


def test_help_is_written_in_any_encoding(monkeypatch):
    """A code page of Windows has no arrows."""
    stream = io.TextIOWrapper(io.BytesIO(), encoding="ascii")
    monkeypatch.setattr(sys, "stdout", stream)
    with pytest.raises(SystemExit) as ended:
        main(["--help"])
    stream.flush()
    assert ended.value.code == 0 and b"photo \\u2192 video" in stream.buffer.getvalue()


def test_the_video_takes_the_photos_name(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "table.jpg").write_bytes(b"no photo")
    assert main(["run", "table.jpg", "--box", "1,2,30,40"]) == 3
    assert "table.jpg" in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir() if path.name.startswith("table_work")] in ([], ["table_work"])


def test_help_lists_every_stage(capsys):
    with pytest.raises(SystemExit) as stopped:
        main(["--help"])
    text = capsys.readouterr().out
    assert stopped.value.code == 0 and all(
        stage in text for stage in ("run", "reconstruct", "bake", "render", "effects", "doctor")
    )


def test_effects_are_listed_for_people_and_for_machines(capsys):
    assert main(["effects"]) == 0
    text = capsys.readouterr().out
    assert "wind (force): " in text and "a = -k |v - w| (v - w)" in text
    assert "wind_x = 3 m/s, -100 to 100: velocity of the air" in text
    assert main(["effects", "--json"]) == 0
    listed = json.loads(capsys.readouterr().out)["effects"]
    assert [effect["name"] for effect in listed] == list(effects())
    assert {"name", "kind", "parameters", "equation"} <= set(listed[0])
    assert {"name", "unit", "low", "high", "default"} <= set(listed[0]["parameters"][0])
    assert main(["effects", "wind", "sandy", "--json"]) == 0
    assert [e["name"] for e in json.loads(capsys.readouterr().out)["effects"]] == ["wind", "sandy"]
    assert main(["effects", "gremlins"]) == 3
    assert "gremlins" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["reconstruct", "missing.jpg", "--box", "0,0,9,9", "--out", "{tmp}/s"], "missing.jpg"),
        (["bake", "{tmp}", "--out", "{tmp}/b"], "scene.json"),
        (["render", "{tmp}", "--bake", "{tmp}", "--out", "{tmp}/f"], "scene.json"),
        (["reconstruct", "{photo}", "--box", "900,900,999,999", "--out", "{tmp}/s"], "box"),
        (["run", "{photo}", "--box", "110,90,210,190", "--out", "{tmp}/v.avi"], ".mp4"),
        (["run", "{photo}", "--box", "110,90,210,190", "--out", "."], ".mp4"),
        (["run", "{photo}", "--box", "110,90,210,190", "--out", "{tmp}/v.mp4", "--scale", "nan"], "scale"),
        (["run", "{photo}", "--box", "110,90,210,190", "--out", "{tmp}/v.mp4", "--quality", "best"], "quality"),
        (["run", "{photo}", "--box", "1,1,9,9", "--out", "{tmp}/v.mp4", "--velocity", "0,0,1", "0,0,2"], "velocity"),
        (["reconstruct", "{photo}", "--box", "110,90,210,190", "--out", "."], "."),
        (["reconstruct", "{photo}", "--box", "110,90,210,190", "--size", "1", "2", "--out", "{tmp}/s"], "--size"),
        (["reconstruct", "{photo}", "--box", "110,90,210,190", "--set", "mug.fill=0", "--out", "{tmp}/s"], "'mug'"),
        (["run", "{photo}", "--box", "1,1,9,9", "--set", "object_1.density=-1", "--out", "{tmp}/v.mp4"], "density"),
    ],
)
def test_bad_input_is_exit_3_and_names_itself(arguments, words, tmp_path, photo, physgen):
    code, _, errors = physgen(*(a.format(tmp=tmp_path, photo=photo) for a in arguments))
    assert code == 3 and errors.startswith("error: ") and words in errors, errors
    assert "Traceback" not in errors
    assert sorted(p.name for p in tmp_path.iterdir() if not p.name.startswith(".")) == [photo.name]


def test_exit_code_and_error_leave_the_process(tmp_path):
    code, events, errors = in_a_process("bake", tmp_path, "--out", tmp_path / "b")
    assert code == 3 and not events and errors.startswith("error: ") and "scene.json" in errors, errors


def bake_here(command, on_event, cancelled, **_):
    """In place of ``run_stage``: the job of the worker in this process, which has the engine's kernels already."""
    return run_job(Path(command[-1]), on_event, cancelled)


@pytest.mark.long
def test_stages_one_by_one(first_fill, tmp_path, photo, physgen, monkeypatch):
    scene, bake = tmp_path / "scene", tmp_path / "bake"
    reconstruct = [
        "reconstruct",
        photo,
        "--box",
        "105,85,215,195",
        "--name",
        "ball",
        "--size",
        "0.08",
        "--out",
        scene,
        "--json",
    ]
    code, events, errors = physgen(*reconstruct, "--preset", "soft", "--velocity", "0,0,0.8")
    assert code == 0, errors
    assert events[-1] == {"event": "done", "scene": str(scene)}
    ball = load_scene(scene).model.objects[0]
    assert (ball.name, ball.material.preset, ball.velocity) == ("ball", "soft", (0.0, 0.0, 0.8))
    assert ball.size_m == pytest.approx(0.08, rel=0.02)

    code, events, errors = physgen("bake", scene, "--out", bake, "--frames", "4", "--quality", "preview", "--json")
    assert code == 0, errors
    assert [e["done"] for e in events if e["event"] == "progress"][-1] == 4
    first = load_manifest(bake)

    monkeypatch.setattr(stages, "run_stage", bake_here)

    # What it would cost is said without a bake, and nothing is written.
    said = (scene / "scene.json").read_bytes()
    heavy = ["--preset", "hard", "--set", "ball.density=700", "--frames", "4", "--quality", "preview", "--json"]
    code, events, errors = physgen("bake", scene, "--estimate", *heavy)
    assert code == 0, errors
    cost = events[-1]
    assert cost["event"] == "done" and cost["particles"] == first.particles and cost["substeps"] > 0
    assert cost["seconds"] > 0 and cost["memory_bytes"] > 2**20 and isinstance(cost["warnings"], list)
    # Nothing that a bake of four frames leaves is larger than what was said.
    assert cost["disk_bytes"] >= disk_usage(bake)
    assert physgen("estimate", scene, *heavy)[1][-1] == cost
    assert (scene / "scene.json").read_bytes() == said
    code, events, errors = physgen("bake", scene, "--estimate", "--set", "ball.velocity=0,0,1e7")
    assert code == 3 and "hours" in errors and "velocity" in errors
    mesh_time = (scene / ball.mesh).stat().st_mtime_ns

    # Another material: no reconstruction, another bake.
    code, events, _ = physgen(*reconstruct, "--preset", "medium")
    assert code == 0 and any("up to date" in e.get("message", "") for e in events)
    assert (scene / ball.mesh).stat().st_mtime_ns == mesh_time
    again = physgen("bake", scene, "--out", bake, "--frames", "4", "--quality", "preview")
    assert again[0] == 0 and load_manifest(bake).inputs_hash != first.inputs_hash

    # What is not said is not remembered: the same command gives the same scene, whatever ran before.
    physgen(*reconstruct)
    ball = load_scene(scene).model.objects[0]
    assert (ball.material.preset, ball.velocity) == ("rubber", (0.0, 0.0, 0.0)), "as things called ball are"

    # The same again: nothing.
    assert physgen("bake", scene, "--out", bake, "--frames", "4", "--quality", "preview")[0] == 0
    code, events, _ = physgen("bake", scene, "--out", bake, "--frames", "4", "--quality", "preview", "--json")
    assert code == 0 and any("up to date" in e.get("message", "") for e in events)


def test_the_callers_signal_handlers_return(capsys):
    numbers = (signal.SIGINT, signal.SIGTERM)
    before = [signal.getsignal(number) for number in numbers]
    assert main(["effects", "wind"]) == 0 and main(["effects", "gremlins"]) == 3
    assert [signal.getsignal(number) for number in numbers] == before


def test_a_signal_is_a_request_to_stop():
    with stop_signals() as stopped:
        assert not stopped()
        signal.raise_signal(signal.SIGTERM)
        assert stopped()


def test_doctor_finds_this_environment_fit():
    code, events, errors = in_a_process("doctor", "--json")
    report = {name: ok for name, ok, _ in events[-1]["report"]}
    assert report["simulation"] and report["numpy"], errors
    assert (code == 0) == all(report.values())


def test_the_demo_names_a_photo_that_is_there():
    from physgen.batch import demo

    config = demo.load_config()
    job = demo.request(config, Path("out"))
    image = cv2.imread(str(job.photo))
    assert image.shape == (400, 600, 3) and config.frames / config.fps >= 3.0
    assert all(0 <= b[0] < b[2] <= 600 and 0 <= b[1] < b[3] <= 400 for b in config.boxes)


def test_a_reader_that_leaves_is_no_crash(photo, tmp_path):
    line = [sys.executable, "-m", "physgen.batch.cli", "reconstruct", str(photo), "--box", "105,85,215,195", "--json"]
    process = subprocess.Popen([*line, "--out", str(tmp_path / "s")], stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    process.stdout.close()
    errors = process.stderr.read()
    process.stderr.close()
    assert process.wait() == 130 and b"Traceback" not in errors, errors


def test_a_bake_is_of_the_scene_that_was_asked_for(ball_scene, tmp_path):
    scene = ball_scene().root
    job = BakeJob(scene=str(scene), out=str(tmp_path / "b"), options=BakeOptions(frames=2), expected_inputs="0" * 64)
    (tmp_path / "job.json").write_text(json.dumps(job_to_json(job)))
    command = [sys.executable, "-m", "physgen.sim.app.bake_worker", str(tmp_path / "job.json")]
    result = subprocess.run(command, capture_output=True, text=True, check=False)
    assert result.returncode == 3 and "changed by another run" in json.loads(result.stdout.splitlines()[-1])["message"]


@pytest.mark.parametrize(
    ("given", "last"),
    [
        (["compos"], "physgen: error: no command 'compos'; did you mean compose?"),
        (["xyzzy"], "physgen: error: no command 'xyzzy'"),
        (
            ["evaluate", "a.mp4", "--againts", "b.mp4"],
            "physgen evaluate: error: unrecognized arguments: --againts b.mp4; did you mean --against?",
        ),
    ],
)
def test_a_typing_error_is_answered_by_what_was_meant(given, last, capsys):
    with pytest.raises(SystemExit) as ended:
        main(given)
    assert ended.value.code == 2
    assert capsys.readouterr().err.strip().splitlines()[-1] == last
