# SPDX-License-Identifier: GPL-3.0-or-later
"""``physgen diagnose`` as a user types it, on motion in closed form: verdict, files, exit codes."""

import json

import numpy as np
import pytest
import trimesh
from physgen.batch.cli import main
from physgen.sim.diagnose.capture import Capture, CaptureObject, Ground, ObjectBelief, Trial
from physgen.sim.diagnose.capture_folder import save_capture
from physgen.sim.diagnose.diagnosis import read_diagnosis
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

GRAVITY = np.array([0.0, 0.0, -9.81])
SIGMA = 5e-4


def throw(name, drag, velocity, spin, rng, *, role="fit", duration=0.5, rate=120.0):
    """A cube in flight under quadratic drag, by an integrator of scipy's; of a predict take the first fifth."""
    times = np.arange(0.0, duration, 1 / rate)
    slope = lambda _, s: np.concatenate([s[3:], GRAVITY - drag * np.linalg.norm(s[3:]) * s[3:]])  # noqa: E731
    start = np.concatenate([[0.0, 0.0, 2.0], velocity])
    way = solve_ivp(slope, (0, duration), start, t_eval=times, rtol=1e-9, atol=1e-10).y[:3].T
    rest = np.asarray(trimesh.creation.box((0.08, 0.08, 0.08)).vertices) * 0.98
    turns = Rotation.from_rotvec(times[:, None] * np.asarray(spin)).as_matrix()
    points = way[:, None] + np.einsum("tij,kj->tki", turns, rest)
    points = points + rng.normal(0, SIGMA, points.shape)
    shown = len(times) // 5 if role == "predict" else len(times)
    trial = Trial(
        name=name, role=role, times=times[:shown], points=points[:shown], pixels=None,
        object_index=np.zeros(8, dtype=np.int64), rest_points=rest,
        predict_times=times[shown:] if role == "predict" else None,
    )  # fmt: skip
    return trial, points[shown:]


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    rng = np.random.default_rng(4)
    takes = [
        throw("one", 0.08, (2.5, 0.0, 1.5), (1, 2, 0), rng),
        throw("two", 0.08, (-1.0, 2.0, 2.0), (0, -2, 3), rng),
        throw("three", 0.08, (0.0, -3.5, 1.0), (2, 0, 1), rng, role="predict"),
    ]
    mesh = trimesh.creation.box((0.08, 0.08, 0.08))
    belief = ObjectBelief(name="cube", mesh="cube.obj", density_kg_m3=150.0, stiffness="hard")
    item = CaptureObject(belief=belief, vertices=np.asarray(mesh.vertices), faces=np.asarray(mesh.faces))
    folder = tmp_path_factory.mktemp("captures") / "Würfel"
    save_capture(
        Capture(
            gravity=(0.0, 0.0, -9.81), ground=Ground(friction=0.4, restitution=0.3), objects=(item,),
            noise_sigma=SIGMA, camera=None, trials=tuple(t for t, _ in takes),
        ),
        folder,
    )  # fmt: skip
    return folder, takes[2][1]


@pytest.mark.long
def test_drag_is_found_predicted_confirmed_and_reported(capture, tmp_path, capsys):
    folder, truth = capture
    out = tmp_path / "diagnosis"
    assert main(["diagnose", str(folder), "--out", str(out), "--json"]) == 0
    events = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert events[-1]["event"] == "done" and events[-1]["effect"] == "air_drag"
    report, where, prediction = read_diagnosis(out)
    assert "air_drag" in (report["verdict"]["effect"], *report["verdict"]["alternatives"])
    assert sum(e["probability"] for e in report["effects"]) == pytest.approx(1.0)
    drag = next(e for e in report["effects"] if e["name"] == "air_drag")["parameters"]["drag_per_mass"]
    low, high = drag["ci95"]
    # Wide enough to hold the truth also where the interval misses it one time in twenty.
    assert abs(drag["value"] - 0.08) < 1.5 * (high - low)
    before, after = (float(np.sqrt(((prediction[f"three.{k}"] - truth) ** 2).mean())) for k in ("before", "after"))
    assert after < 0.25 * before
    assert [take["word"] for take in report["confirmation"]["takes"]] == ["confirmed", "confirmed"]
    assert report["gap"]["resolvable"] and report["gap"]["after_rms_m"] < report["gap"]["before_rms_m"]
    # Drag is along the motion, all of it in flight.
    assert report["where"]["direction"]["along_velocity"] > 0.9
    assert {i["phase"] for i in report["where"]["intervals"]} == {"flight"}
    assert where["one.point_score"].shape == where["one.residual"].shape[:2]
    assert "air drag" in (out / "report.html").read_text(encoding="utf-8").lower()
    # Once more into the same folder replaces it; a folder of something else is refused.
    assert main(["diagnose", str(folder), "--out", str(out), "--effects", "wind", "--no-confirm"]) == 0
    assert {e["name"] for e in read_diagnosis(out)[0]["effects"]} == {"wind", "none", "unknown"}


@pytest.mark.parametrize(
    ("extra", "words"),
    [
        (["--effects", "ghosts"], "ghosts"),
        (["--effects", "sandy"], "sandy"),
        (["--budget", "1s"], "budget"),
        (["--out", "FOREIGN"], "holds no diagnosis"),
        (["--out", "ITSELF"], "is there and holds no diagnosis"),
    ],
)
def test_invalid_arguments_are_refused_at_once(capture, tmp_path, capsys, extra, words):
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "letter.txt").write_text("dear")
    places = {"FOREIGN": str(tmp_path / "other"), "ITSELF": str(capture[0])}
    line = ["diagnose", str(capture[0]), "--out", str(tmp_path / "out"), *(places.get(e, e) for e in extra)]
    assert main(line) == 3
    assert words in capsys.readouterr().err
    assert (tmp_path / "other" / "letter.txt").read_text() == "dear" and not (tmp_path / "out").exists()


def test_a_missing_capture_is_named(tmp_path, capsys):
    assert main(["diagnose", str(tmp_path / "nowhere"), "--out", str(tmp_path / "out")]) == 3
    assert "nowhere" in capsys.readouterr().err
