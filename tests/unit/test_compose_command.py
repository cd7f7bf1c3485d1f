# SPDX-License-Identifier: MIT
"""``physgen compose`` and ``fit-splats``: what is asked for arrives, bad input is exit 3 and changes nothing."""

import json

import pytest
import trimesh
from physgen.batch import cli
from physgen.batch.commands.compose_commands import _lines
from physgen.sim.gaussians.compose.compose_options import ComposeOptions

from .compose_scenes import a_scene, ball


def ended(capsys, *arguments):
    """Exit code and the last event."""
    code = cli.main([*map(str, arguments), "--json"])
    return code, json.loads(capsys.readouterr().out.splitlines()[-1])


def test_the_defaults_are_the_optimisers():
    options = cli.build_parser().parse_args(["compose", "scene", "--out", "new"])
    defaults = ComposeOptions()
    for name in ("steps", "substeps", "cells", "size", "seed", "keep_strain", "guidance_weight"):
        assert getattr(options, name) == getattr(defaults, name)
    assert options.method is None and options.objects == ()
    given = cli.build_parser().parse_args(
        ["compose", "scene", "--out", "new", "--objects", "a, b", "--method", "ppps+sds"]
    )
    assert given.objects == ("a", "b") and given.method == "ppps+sds"


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ((), "has no photo"),
        (("--no-picture", "--method", "sds"), "needs the picture"),
        (("--no-picture", "--steps", "0"), "steps is 0"),
        (("--no-picture", "--objects", "a,c"), "there is no 'c'"),
        (("--no-picture",), "do not touch: they are 20 cm apart"),
        (("--no-picture", "--guidance", "exact:nowhere"), "no such folder nowhere"),
    ],
)
def test_bad_input_is_exit_3(tmp_path, capsys, arguments, words):
    folder = a_scene(tmp_path / "scene", {"a": ball(0), "b": ball(0.3)})
    code, event = ended(capsys, "compose", folder.root, "--out", tmp_path / "out", *arguments)
    assert code == 3 and event["event"] == "error" and words in event["message"]
    assert [path.name for path in tmp_path.iterdir()] == ["scene"]


def test_views_that_cannot_be_used_are_exit_3(tmp_path, capsys):
    trimesh.creation.box().export(tmp_path / "box.ply")
    for arguments, words in (
        ((tmp_path / "nowhere",), "nowhere"),
        ((tmp_path / "nowhere", "--layout", "mvdream"), "layout is 'mvdream'"),
        ((tmp_path / "box.ply", "--layout", "syncdreamer"), "box.ply"),
        ((tmp_path / "nowhere", "--splats", "1"), "splats is 1"),
    ):
        code, event = ended(capsys, "fit-splats", *arguments, "--out", tmp_path / "out")
        assert code == 3 and words in event["message"], event
    assert not (tmp_path / "out").exists()


def test_the_numbers_are_for_people():
    before = {"volume_m3": 2.9e-5, "share": 0.056, "deepest_m": 0.02}
    after = {"volume_m3": 0.0, "share": 0.0, "deepest_m": 0.0}
    alike = [{"psnr_db": 14.48, "ssim": 0.76}, {"psnr_db": None, "ssim": 1.0}]
    record = {
        "pairs": [{"objects": ["a", "b"], "before": before, "after": after}],
        "groups": [{"objects": ["a", "b"], "likeness": alike}, {"objects": ["c", "d"], "likeness": None}],
    }
    assert _lines(record) == [
        "a and b: penetration 29 → 0 cm³ (5.6 → 0 %), deepest 20 → 0 mm",
        "a, b: similarity to the photo 14.48 → ∞ dB, SSIM 0.760 → 1.000",
    ]
