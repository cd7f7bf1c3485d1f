# SPDX-License-Identifier: MIT
"""Diagnoses of made-up takes of a cube, their reports, and what every report must be."""

import dataclasses
import math
import re
import xml.etree.ElementTree as ElementTree
from html.parser import HTMLParser

import numpy as np
from physgen.sim.diagnose.capture import Camera, Capture, CaptureObject, Ground, ObjectBelief, Trial
from physgen.sim.diagnose.diagnosis import (
    Diagnosis,
    Gap,
    IntervalShare,
    Localisation,
    ObjectShare,
    RankedEffect,
    TrialArrays,
    Verdict,
)
from physgen.sim.diagnose.fits import Estimate
from physgen.sim.diagnose.report import write_report
from physgen.sim.diagnose.report.trajectory_plots import camera_plane

NAN = math.nan
FILES = {"report.html", "timeline.svg", "object.svg", "ranking.svg", "gap.svg", "tracks.svg"}
HOSTILE = "<script>alert(1)</script>\"'&]]> \u202egnp\x00\ud800" + "x" * 300
SVG = "{http://www.w3.org/2000/svg}"

CORNERS = np.array([[x, y, z] for x in (-0.05, 0.05) for y in (-0.05, 0.05) for z in (-0.05, 0.05)])
FACES = np.array(
    [
        [0, 1, 3],
        [0, 3, 2],
        [4, 6, 7],
        [4, 7, 5],
        [0, 4, 5],
        [0, 5, 1],
        [2, 3, 7],
        [2, 7, 6],
        [0, 2, 6],
        [0, 6, 4],
        [1, 5, 7],
        [1, 7, 3],
    ]
)
CAMERA = Camera(
    width=640,
    height=480,
    fx=500.0,
    fy=500.0,
    cx=320.0,
    cy=240.0,
    world_from_camera=((1.0, 0, 0, 0), (0, 0, 1.0, -3.0), (0, -1.0, 0, 0.5), (0, 0, 0, 1.0)),
)


def cube(name="cube"):
    belief = ObjectBelief(name=name, mesh="cube.obj", density_kg_m3=200.0, stiffness="hard")
    return CaptureObject(belief=belief, vertices=CORNERS, faces=FACES)


def take(name="take01", *, role="fit", frames=20, points=8, camera=None, seed=0):
    """A thrown cube, and what a model without and with drag makes of it."""
    random = np.random.default_rng(seed)
    times = 0.1 + np.arange(frames) / 100
    wanted = times[-1] + 0.01 * np.arange(1, 11) if role == "predict" else None
    rest = CORNERS[np.arange(points) % 8]

    def way(t, drag):
        s = (t - 0.1)[:, None]
        return np.array([0, 0, 1.0]) + s * [2, 0, 1] - s**2 * [drag, 0, 4.905] + 0 * s

    nominal, found = (way(times, d)[:, None] + rest for d in (0.0, 0.8))
    points3 = found + random.normal(0, 1e-3, found.shape)
    points3[random.random(points3.shape[:2]) < 0.1] = NAN
    pixels = None
    residual = points3 - nominal
    if camera is not None:
        pixels = camera_plane(camera)(points3)
        residual = pixels - camera_plane(camera)(nominal)
    trial = Trial(
        name=name,
        role=role,
        times=times,
        points=None if pixels is not None else points3,
        pixels=pixels,
        object_index=np.zeros(points, dtype=np.int64),
        rest_points=rest,
        predict_times=wanted,
    )
    score = 1.6 + 0.1 * random.random(frames)
    arrays = TrialArrays(
        times=times,
        frame_score=score,
        point_score=np.tile(score[:, None], (1, points)),
        residual=residual,
        nominal=nominal,
        found=found,
        before=None if wanted is None else way(wanted, 0.0)[:, None] + rest,
        after=None if wanted is None else way(wanted, 0.8)[:, None] + rest,
    )
    return trial, arrays


def case(*takes, objects=None, camera=None, **changes):
    """A diagnosis of air drag and its capture; ``changes`` replace fields of the diagnosis."""
    takes = takes or (take(camera=camera), take("take02", role="predict", seed=1, camera=camera))
    objects = objects or (cube(),)
    capture = Capture(
        gravity=(0.0, 0.0, -9.81),
        ground=Ground(),
        objects=objects,
        noise_sigma=1e-3 if camera is None else 0.5,
        camera=camera,
        trials=tuple(t for t, _ in takes),
    )
    drag = Estimate(value=0.0405, unit="1/m", low=0.0381, high=0.0429)
    diagnosis = Diagnosis(
        verdict=Verdict(effect="air_drag", probability=0.93, alternatives=("wind",), effects=("air_drag",)),
        effects=(
            RankedEffect(
                name="air_drag",
                kind="force",
                probability=0.93,
                parameters={"drag_per_mass": drag},
                heldout_rms_m=0.0027,
                closed_fraction=0.98,
            ),
            RankedEffect(name="wind", kind="force", probability=0.06),
            RankedEffect(name="none", kind="none", probability=0.01),
        ),
        gap=Gap(
            before_rms_m=0.054,
            refitted_rms_m=0.015,
            after_rms_m=0.0027,
            noise_floor_rms_m=0.0017,
            closed_fraction=0.98,
            closed_fraction_ci95=(0.96, 0.99),
            resolvable=True,
            numerics_rms_m=4e-4,
        ),
        controls={"wrong_effect_rms_m": 0.014, "last_residual_rms_m": 0.041},
        next_experiment="Throw it both ways.",
        where=Localisation(
            objects=tuple(ObjectShare(name=o.name, share=1 / len(objects)) for o in objects),
            intervals=tuple(
                IntervalShare(trial=t.name, start_s=0.1, end_s=0.2, phase="flight", share=0.5) for t, _ in takes
            ),
            direction={"normal": 0.0, "along_velocity": 0.9, "along_gravity": 0.05, "other": 0.05},
        ),
        trials={t.name: a for t, a in takes},
        summary="The air slows it down.",
    )
    return dataclasses.replace(diagnosis, **changes), capture


def written(diagnosis, capture, out):
    """The page's text and the names of all files, once they have been held to what every report must be."""
    write_report(diagnosis, capture, out)
    for path in out.iterdir():
        check(path.name, path.read_text(encoding="utf-8"))
    return (out / "report.html").read_text(encoding="utf-8"), {path.name for path in out.iterdir()}


class _Page(HTMLParser):
    """Tags opened and closed, attributes, and text outside of style."""

    def __init__(self):
        super().__init__()
        self.open, self.attributes, self.said, self.tags = [], [], "", set()

    def handle_starttag(self, tag, attributes):
        self.tags.add(tag)
        self.attributes += attributes
        if tag != "meta":
            self.open.append(tag)

    def handle_startendtag(self, tag, attributes):
        self.tags.add(tag)
        self.attributes += attributes

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        if self.open and self.open[-1] != "style":
            self.said += data


def check(name, content):
    """Well-formed, nothing from outside, nothing that runs, every picture with a title and a description."""
    tree = ElementTree.fromstring(content.removeprefix("<!DOCTYPE html>\n"))
    page = _Page()
    page.feed(content.partition("?>\n")[2] if name.endswith(".svg") else content)
    assert page.open == []
    assert not page.tags & {"script", "iframe", "object", "embed", "link", "base", "form", "img", "use", "b"}
    identifiers = [value for key, value in page.attributes if key == "id"]
    assert len(identifiers) == len(set(identifiers))
    for key, value in page.attributes:
        assert not key.startswith("on") and key not in ("src", "srcset", "action", "style")
        assert key not in ("href", "xlink:href") or value.startswith("data:image/png;base64,")
        assert key != "aria-labelledby" or set(value.split()) <= set(identifiers)
    assert "url(" not in content and "@import" not in content
    assert not re.search(r"https?:", content.replace('xmlns="http://www.w3.org/2000/svg"', ""))
    for d in re.findall(r' d="([^"]*)"', content):
        assert "nan" not in d and "inf" not in d
    space = SVG if name.endswith(".svg") else ""
    for picture in tree.iter(f"{space}svg"):
        if picture.get("aria-hidden") != "true":
            assert [picture[0].tag, picture[1].tag] == [f"{space}title", f"{space}desc"]
            assert picture[0].text and picture[1].text
    assert not re.search("[\x00-\x08\x0b\x0c\x0e-\x1f\u202e\ud800-\udfff]", content)
    return page


def said(page):
    """All text of the page."""
    return check("report.html", page).said
