# SPDX-License-Identifier: MIT
"""No report contradicts itself: a checker reads diagnoses of drops, throws and bounces, with and without a cause."""

import copy
import html
import json
import re

import numpy as np
import pytest
import trimesh
from physgen.sim.app.add_effect import found_effects
from physgen.sim.app.diagnose import diagnose
from physgen.sim.diagnose.capture import Camera, Capture, CaptureObject, Ground, ObjectBelief, Trial
from physgen.sim.diagnose.capture_folder import load_capture, save_capture
from physgen.sim.diagnose.diagnosis import read_diagnosis
from physgen.sim.diagnose.provenance import content_hash
from physgen.sim.diagnose.run_diagnosis import DiagnoseOptions

from .report_contradictions import contradictions

RADIUS, SIGMA = 0.04, 1e-3
GRAVITY = np.array([0.0, 0.0, -9.81])


def flight(drag=0.0, kick=0.0, velocity=(2.0, 0.0, 3.0), start=(0.0, 0.0, 2.0), times=None, gravity=GRAVITY):
    """Positions of a ball under drag, with a push in mid-flight, in small steps."""
    times = np.arange(0, 0.6, 0.02) if times is None else times
    x, v, found, fine = np.array(start), np.array(velocity), [], 100
    for i, t in enumerate(times):
        found.append(x.copy())
        step = (times[min(i + 1, len(times) - 1)] - t) / fine
        for _ in range(fine):
            v = v + step * (gravity - drag * np.linalg.norm(v) * v)
            x = x + step * v
        if i == len(times) // 2:
            v = v + np.array([0.0, kick, 0.0])
    return np.array(found)


def bounces(restitution, height, times):
    """Heights of a ball's centre dropped without drag."""
    found = []
    for t in times:
        h, v, left = height, 0.0, t
        while True:
            reach = (v + np.sqrt(v * v + 2 * 9.81 * (h - RADIUS))) / 9.81
            if left < reach or v < 0:
                break
            left, v, h = left - reach, restitution * (9.81 * reach - v), RADIUS
        found.append([0.0, 0.0, h + v * left - 4.905 * left**2])
    return np.array(found)


def trial(name, way, times, rng, *, points=6, sigma=SIGMA, role="fit", shown=None):
    rest = RADIUS * np.concatenate([np.eye(3), -np.eye(3)]) if points > 1 else np.zeros((1, 3))
    seen = way[:, None] + rest + rng.normal(0, sigma, (len(way), len(rest), 3))
    cut = len(times) if shown is None else shown
    return Trial(
        name=name, role=role, times=times[:cut], points=seen[:cut], pixels=None,
        object_index=np.zeros(len(rest), dtype=np.int64), rest_points=rest,
        predict_times=times[cut:] if shown is not None else None,
    )  # fmt: skip


def filmed(trial, camera, rng):
    """The trial as pixels of ``camera``."""
    world = np.array(camera.world_from_camera)
    local = (trial.points - world[:3, 3]) @ world[:3, :3]
    pixels = local[..., :2] / local[..., 2:] * (camera.fx, camera.fy) + (camera.cx, camera.cy)
    return Trial(**{**trial.__dict__, "points": None, "pixels": pixels + rng.normal(0, PIXEL, pixels.shape)})


PIXEL = 0.5
CAMERA = Camera(
    width=1280, height=720, fx=900.0, fy=900.0, cx=640.0, cy=360.0,
    world_from_camera=((1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 1.0, -4.0), (0.0, -1.0, 0.0, 2.0), (0.0, 0.0, 0.0, 1.0)),
)  # fmt: skip
"""Looks along +y from four metres away."""


def made(kind):
    """A capture, the candidates to try, and the setting for the checker."""
    rng = np.random.default_rng(5)
    times, sigma, foot, friction = np.arange(0, 0.6, 0.02), SIGMA, -50.0, 0.4
    names, setting = ("air_drag", "wind", "buoyancy"), {"lands": False}
    throws = ((2.0, 0.0, 3.0), (-1.0, 2.0, 3.5), (0.5, -2.5, 2.0))
    if kind == "drop":
        times, sigma, setting = np.arange(0, 2.4, 1 / 15), 0.04, {"dropped": True, "lands": False}
        names = (*names, "time_scale", "friction")
        ways = [flight(0.02, velocity=(0.0, 0.0, -v), times=times) for v in (3.0, 3.4, 2.6)]
        takes = [trial(f"drop{i}", w, times, rng, points=1, sigma=sigma) for i, w in enumerate(ways)]
    elif kind == "bounce":
        times, foot, setting = np.arange(0, 0.9, 0.02), 0.0, {"dropped": True}
        names = ("restitution", "friction", "air_drag")
        takes = [trial(f"drop{i}", bounces(0.6, h, times), times, rng) for i, h in enumerate((0.4, 0.5, 0.6))]
    else:
        drag, kick = {"plain": (0.0, 0.0), "kick": (0.0, 1.5)}.get(kind, (0.12, 0.0))
        gravity = GRAVITY + ((0.3, -0.4, 0.0) if kind == "pair" else (0.0, 0.0, 0.0))
        names = (*names, "gravity_tilt") if kind == "pair" else names
        ways = [flight(drag, kick, v, gravity=gravity) for v in throws]
        # Pixels gain noise of their own.
        noise = 0.0 if kind == "pixels" else sigma
        takes = [trial(f"throw{i}", w, times, rng, sigma=noise) for i, w in enumerate(ways)]
    last = takes[-1]
    takes[-1] = trial("last", last.points.mean(axis=1), times, rng, points=len(last.rest_points), sigma=1e-9,
                      role="predict", shown=len(times) // 3)  # fmt: skip
    camera = CAMERA if kind == "pixels" else None
    if camera is not None:
        takes, sigma = [filmed(t, camera, rng) for t in takes], PIXEL
    mesh = trimesh.creation.icosphere(subdivisions=3, radius=RADIUS)
    belief = ObjectBelief(name="ball", mesh="ball.obj", density_kg_m3=150.0, stiffness="hard")
    item = CaptureObject(belief=belief, vertices=np.asarray(mesh.vertices), faces=np.asarray(mesh.faces))
    ground = Ground(point=(0.0, 0.0, foot), friction=friction, restitution=0.8)
    return Capture(
        gravity=tuple(GRAVITY), ground=ground, objects=(item,), noise_sigma=sigma, camera=camera, trials=tuple(takes)
    ), names, setting  # fmt: skip


EXPECTED = {
    "plain": "none",
    "drag": "air_drag",
    "kick": "unknown",
    "drop": "air_drag",
    "bounce": "restitution",
    "pair": "gravity_tilt",
    "pixels": "air_drag",
}


class Reports(dict):
    """report.json, the page's text and the setting, by kind; each is made when it is first asked for."""

    def __init__(self, root):
        super().__init__()
        self.root, self.events = root, {}

    def __missing__(self, kind):
        root = self.root
        capture, names, setting = made(kind)
        save_capture(capture, root / kind)
        options = DiagnoseOptions(effects=names, confirm=False)
        events = self.events[kind] = []
        diagnose(load_capture(root / kind), out=root / f"{kind}_out", options=options, on_event=events.append)
        page = (root / f"{kind}_out" / "report.html").read_text(encoding="utf-8")
        words = html.unescape(re.sub(r"<[^>]+>", "", re.sub(r"<style>.*?</style>", "", page, flags=re.S)))
        self[kind] = read_diagnosis(root / f"{kind}_out")[0], words, setting
        return self[kind]


@pytest.fixture(scope="module")
def reports(tmp_path_factory):
    return Reports(tmp_path_factory.mktemp("reports"))


@pytest.mark.parametrize("kind", [pytest.param(k, marks=pytest.mark.long) if k == "pixels" else k for k in EXPECTED])
def test_no_line_contradicts_another(reports, kind):
    report, page, setting = reports[kind]
    assert contradictions(report, page, **setting) == []
    verdict = report["verdict"]
    assert EXPECTED[kind] in (verdict["effect"], *verdict["alternatives"])


def test_the_fits_have_ended_only_when_pairs_are_tried_and_judged(reports):
    """A bar that is full while the longest part is to come says that no time is left."""
    assert reports["pair"]
    told = [e for e in reports.events["pair"] if e["event"] == "progress" and e["stage"] == "fit"]
    assert [e["done"] for e in told] == list(range(1, told[-1]["total"] + 1))
    assert [e["message"] for e in told[-3:]] == ["best again", "pairs", "judged"]


def test_two_causes_are_told_on_one_line(reports):
    """Drag of 0.12 1/m and ground that leans: both numbers come from the fit of both, and both go into a scene."""
    report, page, _ = reports["pair"]
    assert sorted(report["verdict"]["effects"]) == ["air_drag", "gravity_tilt"] == sorted(found_effects(report))
    drag, tilt = sorted(report["pair"]["adds"], key=lambda one: one["effect"])
    assert drag["parameters"]["drag_per_mass"]["value"] == pytest.approx(0.12, rel=0.1)
    assert tilt["parameters"]["angle"]["value"] == pytest.approx(np.arctan2(0.5, 9.81), rel=0.1)
    assert min(drag["without_rms_m"], tilt["without_rms_m"]) > report["gap"]["after_rms_m"]
    assert page.count("Two causes, found together") == 1 and "nats" in page


def test_capture_command_and_version_are_on_the_page(reports):
    report, page, _ = reports["drag"]
    made_of = report["provenance"]
    assert made_of["capture"] == "drag" and "“drag”" in page
    assert made_of["command"] == (
        "physgen diagnose drag --out DIR --budget 300s --effects air_drag,wind,buoyancy --no-confirm"
    )


def test_effects_that_change_nothing_are_folded_into_a_line(reports):
    report, page, _ = reports["drop"]
    row = next(r for r in report["effects"] if r["name"] == "friction")
    assert row["reason"] == "the same motion as without it"
    assert re.search(r"No different from the nominal model in this capture, together [^:]*: friction\.", page)


def test_the_hash_is_of_what_was_measured():
    capture, _, _ = made("plain")
    same, _, _ = made("plain")
    assert content_hash(capture) == content_hash(same)
    moved = Trial(**{**capture.trials[0].__dict__, "times": capture.trials[0].times + 1e-9})
    assert content_hash(Capture(**{**capture.__dict__, "trials": (moved, *capture.trials[1:])})) != content_hash(
        capture
    )
    ground = Ground(point=capture.ground.point, friction=0.41, restitution=0.8)
    assert content_hash(Capture(**{**capture.__dict__, "ground": ground})) != content_hash(capture)


def doctored(kind, change):
    def apply(reports):
        report, page, setting = copy.deepcopy(reports[kind][0]), reports[kind][1], dict(reports[kind][2])
        page = change(report, page) or page
        return report, page, setting

    return apply


def _row(report, name):
    return next(r for r in report["effects"] if r["name"] == name)


DOCTORED = {
    "not to be trusted": doctored("drag", lambda r, p: p + " do not trust this cause"),
    "own uncertainty, unsaid": doctored("drag", lambda r, p: r["gap"].update(grain_rms_m=9.0)),
    "two errors of the pair": doctored("pair", lambda r, p: r["pair"].update(heldout_rms_m=0.5)),
    "the pair is not the verdict": doctored("pair", lambda r, p: r["pair"].update(probability=0.01)),
    "adds nothing to the other": doctored("pair", lambda r, p: r["pair"]["adds"][0].update(nats=-3.0)),
    "closes 100%": doctored("kick", lambda r, p: _row(r, "wind").update(closed_fraction=1.0, reason="x")),
    "closes 178%": doctored("drag", lambda r, p: _row(r, "wind").update(closed_fraction=1.78)),
    "not around": doctored("drag", lambda r, p: r["gap"].update(closed_fraction_ci95=[0.78, 1.87])),
    "-17000000000.0": doctored("drag", lambda r, p: r["gap"].update(closed_fraction_ci95=[-1.7e10, 1.0])),
    "below the noise floor": doctored("drag", lambda r, p: r["gap"].update(noise_floor_rms_m=0.069)),
    "more numerical error": doctored(
        "drag", lambda r, p: r["gap"].update(numerics_rms_m=0.028, after_rms_m=0.0037) or p + " own numerical error"
    ),
    "cannot be repeated so": doctored(
        "drop", lambda r, p: r.update(next_experiment="Throw the object the opposite way at the same speed.")
    ),
    "nothing lands there": doctored("drop", lambda r, p: r.update(next_experiment="Let the object bounce.")),
    "nothing is missing, with": doctored("plain", lambda r, p: r["gap"].update(before_rms_m=0.031, resolvable=True)),
    "a share of the gap is closed": doctored("plain", lambda r, p: r["gap"].update(closed_fraction=0.4)),
    "two causes without their line": doctored("drag", lambda r, p: r["verdict"].update(effects=["air_drag", "wind"])),
    "without a reason": doctored("drag", lambda r, p: _row(r, "buoyancy").update(reason="")),
    "is not on the page": doctored("drag", lambda r, p: p.replace(r["provenance"]["content_sha256"], "")),
    "unsaid": doctored("drag", lambda r, p: r["work"]["skipped"].update(tether="tried")),
    "explained down to its noise": doctored(
        "plain",
        lambda r, p: r["gap"].update(
            before_rms_m=2 * np.hypot(r["gap"]["noise_floor_rms_m"], r["gap"]["grain_rms_m"]), resolvable=True
        ),
    ),
    "“Nothing is missing”, with": doctored(
        "plain",
        lambda r, p: r["gap"].update(before_rms_m=2 * np.hypot(r["gap"]["noise_floor_rms_m"], r["gap"]["grain_rms_m"])),
    ),
    "a cause with an error of 0.031": doctored(
        "drag",
        lambda r, p: r["gap"].update(after_rms_m=0.031) or p.replace("not the whole cause", ""),
    ),
    "below the noise floor, unexplained": doctored(
        "drag", lambda r, p: r["controls"].update(wrong_effect_rms_m=0.0) or p.replace("below it is so by chance", "")
    ),
    "re-fitting does as well or better": doctored(
        "drag",
        lambda r, p: (
            r["gap"].update(refitted_rms_m=0.5 * r["gap"]["after_rms_m"])
            or p + " the nominal model's own parameters does as well"
        ),
    ),
    "one of several": doctored("drag", lambda r, p: p + " Mean of 1 trials. "),
    "smaller than an atom": doctored("drag", lambda r, p: p + " 1.14 × 10⁻⁸\u00a0µm"),
    "two errors of the nominal": doctored("kick", lambda r, p: _row(r, "none").update(heldout_rms_m=9.0)),
    "allowed": doctored(
        "drag", lambda r, p: _row(r, "air_drag")["parameters"]["drag_per_mass"].update(ci95=[-1.7e10, 1])
    ),
}


@pytest.mark.parametrize("words", DOCTORED)
def test_the_checker_sees(reports, words):
    report, page, setting = DOCTORED[words](reports)
    assert any(words in said for said in contradictions(report, page, **setting)), json.dumps(report["gap"])
