# SPDX-License-Identifier: MIT
"""The assets of the composition benchmark: shapes, starts, cameras, tables. Nothing is rendered."""

from __future__ import annotations

import dataclasses
import json
import math

import numpy as np
import pytest
from physgen.benchmarks.compose_assets import results, sdf
from physgen.benchmarks.compose_assets.asset import Part
from physgen.benchmarks.compose_assets.catalogue import NAMES, asset
from physgen.benchmarks.compose_assets.pictures import (
    FITTING,
    HELD_OUT,
    REFERENCE,
    RING,
    cache_name,
    cameras,
    renderings,
)
from physgen.benchmarks.compose_assets.sdf import Bulge, Warp, mesh_of
from physgen.benchmarks.compose_assets.tables import TABLES
from physgen.benchmarks.compose_assets.trial import common_volume, overlap, volume
from PIL import Image
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree


def check_closed_manifold(part):
    directed = part.faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
    keys = directed[:, 0] * len(part.vertices) + directed[:, 1]
    back = directed[:, 1] * len(part.vertices) + directed[:, 0]
    assert len(np.unique(keys)) == len(keys), "an edge runs twice in the same direction"
    assert np.array_equal(np.sort(keys), np.sort(back)), "an edge has no face on its other side"
    links = coo_matrix((np.ones(len(directed)), tuple(directed.T)), shape=(len(part.vertices),) * 2)
    assert connected_components(links)[0] == 1
    assert volume(part) > 0


@pytest.mark.long
@pytest.mark.parametrize("name", NAMES)
def test_parts_fit_at_the_truth_and_not_at_the_start(name):
    item = asset(name)
    for part in item.parts:
        check_closed_manifold(part)
        assert part.colours.shape == part.vertices.shape
        assert part.colours.min() >= 0 and part.colours.max() <= 1
        # Plain things could slide along themselves unseen.
        assert part.colours.std(axis=0).max() > 0.05
    assert min(part.vertices[:, 2].min() for part in item.parts) == pytest.approx(0.0, abs=0.01 * item.size)
    body, start = item.background, item.start
    moved = np.linalg.norm(start.vertices - body.vertices, axis=1).max() / item.size
    assert 0.03 <= moved <= 0.08
    assert np.linalg.det(item.warp.jacobian(body.vertices)).min() > 0.5
    for worn in item.foregrounds:
        assert common_volume(body, worn, cells=192) == 0
        assert cKDTree(worn.vertices).query(body.vertices)[0].min() < 0.01 * item.size
        assert 0.04 < common_volume(start, worn) / volume(worn) < 0.17
    for one, other in zip(item.foregrounds, item.foregrounds[1:], strict=False):
        assert common_volume(one, other) == 0


@pytest.mark.long
def test_there_are_eight_pairs_and_one_of_three():
    counts = [len(asset(name).parts) for name in NAMES]
    assert counts.count(2) >= 8 and counts.count(3) >= 1


@pytest.mark.parametrize(("name", "count"), [("loaf", 2), ("burger", 3), ("cushions", 4), ("fruit", 5)])
def test_things_on_a_table_start_in_each_other(name, count):
    things = [
        Part(name=str(i), vertices=t.vertices, faces=t.faces, colours=t.vertices) for i, t in enumerate(TABLES[name]())
    ]
    assert len(things) == count
    size = np.ptp(np.concatenate([thing.vertices for thing in things]), axis=0).max()
    assert -1e-6 * size < min(thing.vertices[:, 2].min() for thing in things) < 0.025 * size
    for i, thing in enumerate(things):
        check_closed_manifold(thing)
        # Each of the others reaches into one that is composed before it.
        assert i == 0 or max(common_volume(thing, other, cells=48) for other in things[:i]) > 1e-4 * volume(thing)


def test_overlap_of_two_balls_is_the_lens_between_them():
    first, second, apart = 0.05, 0.04, 0.07
    parts = []
    for centre, radius in ((0.0, first), (apart, second)):
        vertices, faces = mesh_of(sdf.sphere((centre, 0, 0), radius), (-0.06,) * 3, (0.12, 0.06, 0.06), 0.002)
        parts.append(dataclasses.replace(asset("bowl").background, vertices=vertices, faces=faces, colours=vertices))
    a, b = parts
    check_closed_manifold(a)
    assert volume(a) == pytest.approx(4 / 3 * math.pi * first**3, rel=2e-3)
    lens = math.pi * (first + second - apart) ** 2
    lens *= apart**2 + 2 * apart * (first + second) - 3 * (first - second) ** 2
    found = overlap(a, b)
    assert found.volume == pytest.approx(lens / (12 * apart), rel=0.02)
    assert found.depth == pytest.approx(first + second - apart, rel=0.02)
    assert found.gap == 0
    assert common_volume(a, b.moved(b.vertices + np.array([0.03, 0.0, 0.0]))) == 0


@pytest.mark.parametrize(
    "field",
    [
        sdf.sphere((0.01, 0, 0), 0.03),
        sdf.cone((0, 0, 0), (0.03, 0.01, 0.05), 0.02, 0.008),
        sdf.box_sdf((0, 0, 0.01), (0.02, 0.03, 0.01), 0.004),
        sdf.torus((0, 0, 0), 0.03, 0.01, (1.0, 1.0, 0.3)),
        sdf.revolved([(0.01, 0.0), (0.03, 0.0), (0.02, 0.04), (0.01, 0.03)], 0.002),
    ],
)
def test_distances_of_solids_are_distances(field):
    points = np.random.default_rng(0).uniform(-0.08, 0.08, (400, 3))
    outside = points[field(points) > 0.002]
    step = 1e-6
    slope = np.stack([(field(outside + s) - field(outside - s)) / (2 * step) for s in step * np.eye(3)], axis=1)
    length = np.linalg.norm(slope, axis=1)
    assert np.quantile(np.abs(length - 1), 0.98) < 1e-5
    # Whoever walks the distance along the slope arrives at the surface.
    landed = field(outside - field(outside)[:, None] * slope)
    assert np.quantile(np.abs(landed), 0.98) < 1e-6


def test_jacobian_of_a_warp_is_its_derivative():
    warp = Warp(
        base=(0.01, 0.0, 0.02),
        height=0.3,
        scale=(1.04, 0.97, 1.02),
        bend=(0.02, -0.01),
        twist=0.2,
        bulges=(Bulge(centre=(0.0, 0.05, 0.1), radius=0.05, shift=(0.01, 0.0, -0.004), swell=0.2),),
    )
    points = np.random.default_rng(1).uniform(-0.1, 0.3, (50, 3))
    step = 1e-6
    found = np.stack([(warp(points + s) - warp(points - s)) / (2 * step) for s in step * np.eye(3)], axis=2)
    assert np.allclose(warp.jacobian(points), found, atol=1e-7)
    assert np.allclose(Warp(height=1.0)(points), points)


def test_cameras_ring_the_asset_and_hold_it():
    item = asset("ring")
    seen = cameras(item, 128)
    points = np.concatenate([part.vertices for part in (item.start, *item.parts)])
    for camera in seen.values():
        pixels = camera.project(points)
        assert pixels[:, :2].min() > 0 and pixels[:, :2].max() < 128 and pixels[:, 2].min() > 0
    middle = (item.background.vertices.min(axis=0) + item.background.vertices.max(axis=0)) / 2
    ring = [seen[place.name].position - middle for place in FITTING[:RING]]
    turns = np.degrees(np.unwrap([math.atan2(away[1], away[0]) for away in ring]))
    assert np.allclose(np.diff(turns), 22.5, atol=2.0)
    ways = {(place.azimuth, place.elevation) for place in (REFERENCE, *FITTING)}
    assert not ways & {(place.azimuth, place.elevation) for place in HELD_OUT}
    # From the front: the stone is seen, and its colour with it.
    assert ring[0][1] < 0


def test_folder_changes_with_what_is_seen():
    item = asset("bowl")
    name = cache_name(item, 128)
    assert name == cache_name(item, 128) and name.startswith("bowl-128-")
    paler = dataclasses.replace(item.background, colours=0.9 * item.background.colours)
    larger = item.background.moved(1.01 * item.background.vertices)
    others = {cache_name(dataclasses.replace(item, background=other), 128) for other in (paler, larger)}
    assert len({name, cache_name(item, 256), *others}) == 4
    assert [sub for sub, _, _ in renderings(item)] == ["composition", "ball", "bowl"]


def row(method, psnr, after, **changes):
    values = {
        "asset": "ring",
        "method": method,
        "psnr_reference": psnr,
        "ssim_reference": 0.95,
        "psnr_held_out": psnr - 2,
        "ssim_held_out": 0.9,
        "penetration_before": 2e-6,
        "penetration_after": after,
        "penetrating_before": 0.1,
        "penetrating_after": 0.0,
        "stays_together": True,
        "cpu_s": 10.0,
    }
    return results.Row(**{**values, **changes})


ROWS = [
    row("ppps", 25.0, 0.0),
    row("pse-sds", 31.0, 0.0),
    row("pse-sds", 33.0, 3e-8, asset="hat", stays_together=False, cpu_s=20.0),
    row("sds", 30.0, 1e-6, clip=80.0),
    row("ppps+sds", 21.0, 0.0),
]


def test_means_are_over_assets_in_the_papers_order():
    found = results.means([*ROWS, row("start", 20.0, 2e-6)])
    assert [mean.method for mean in found] == [*results.METHODS, "start"]
    best = found[0]
    assert (best.assets, best.stay_together) == (2, 1)
    assert best.psnr_reference == pytest.approx(32.0) and best.cpu_s == pytest.approx(15.0)
    assert best.left == pytest.approx(0.0075) and best.worst_left == pytest.approx(0.015)
    assert best.clip is None and found[1].clip == pytest.approx(80.0)


def test_verdicts_say_what_is_and_what_is_not_so():
    assert [verdict.good for verdict in results.verdicts(ROWS)] == [True, True, True, True]
    worse = [row("pse-sds", 29.0, 1e-6), *ROWS[3:]]
    assert [verdict.good for verdict in results.verdicts(worse)] == [False, False, False, False]
    assert results.verdicts([row("sds", 20.0, 0.0)]) == ()


def test_nothing_left_of_nothing():
    assert row("sds", 20.0, 0.0, penetration_before=0.0).left == 0
    assert math.isinf(row("sds", 20.0, 1e-9, penetration_before=0.0).left)


def test_tables_show_every_number_once_in_its_column():
    lines = results.text(ROWS).splitlines()
    assert lines[0].split()[:3] == ["asset", "method", "PSNR"]
    assert any(line.startswith("pse-sds") and "29.79" in line and "32.00" in line for line in lines)
    assert "Part123 17.52" in results.text(ROWS) and "25.02" in results.markdown(ROWS)
    for block in results.markdown(ROWS).split("\n\n"):
        if block.startswith("|"):
            assert len({line.count("|") for line in block.strip().splitlines()}) == 1
    document = results.document([*ROWS, row("sds", math.inf, 0.0)])
    again = json.loads(json.dumps(document, allow_nan=False))
    assert again["rows"][1]["left"] == 0 and again["rows"][-1]["psnr_reference"] is None
    assert again["paper"]["table_2_psnr_db"]["ppps+sds"] == 20.74


def test_contact_sheet_has_a_place_for_every_picture(tmp_path):
    red = np.broadcast_to(np.array([1.0, 0.0, 0.0]), (64, 64, 3))
    line = results.Line(
        title="ring", truth=red, start=red, methods={"sds": red, "ppps": None}, captions={"sds": "30 dB"}
    )
    results.contact_sheet([line, line], tmp_path / "sheet.png")
    pixels = np.asarray(Image.open(tmp_path / "sheet.png"))
    tall = results.SIDE + results.LABEL
    assert pixels.shape == (2 * tall, 4 * results.SIDE, 3)
    middles = pixels[tall + results.LABEL + results.SIDE // 2, results.SIDE // 2 :: results.SIDE]
    assert middles.tolist() == [[255, 0, 0]] * 3 + [[255, 255, 255]]
