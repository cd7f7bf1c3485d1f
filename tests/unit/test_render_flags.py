# SPDX-License-Identifier: GPL-3.0-or-later
"""Options of rendering survive the way through a command line."""

import argparse

import pytest
from hypothesis import given
from hypothesis import strategies as st
from physgen.batch.commands.render_commands import add_render_flags, render_options
from physgen.physgen_addon.render.render_options import RenderOptions, render_arguments
from physgen.sim.errors import InputError


def parse(arguments):
    parser = argparse.ArgumentParser()
    add_render_flags(parser)
    return render_options(parser.parse_args(arguments))


def test_no_flags_give_the_defaults():
    assert parse([]) == RenderOptions()
    assert render_arguments(RenderOptions()) == []


@given(
    samples=st.integers(1, 4096),
    scale=st.floats(0.001, 4.0),
    light_scale=st.none() | st.floats(0.001, 1.0),
    denoise=st.booleans(),
    threads=st.integers(0, 1024),
)
def test_options_come_back_as_they_went(samples, scale, light_scale, denoise, threads):
    options = RenderOptions(samples=samples, scale=scale, light_scale=light_scale, denoise=denoise, threads=threads)
    assert parse(render_arguments(options)) == options


def test_a_value_out_of_range_is_named():
    with pytest.raises(InputError, match="scale is 9"):
        parse(["--scale", "9"])
