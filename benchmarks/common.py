# SPDX-License-Identifier: GPL-3.0-or-later
"""Helpers of the benchmarks: command line, output, small bakes."""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import sys
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from physgen.sim.cache.bake_folder import BakedObject, BakeManifest, save_manifest
from physgen.sim.cache.pc2 import Pc2Writer
from physgen.sim.version import VERSION

QUICK_HELP = "seconds: checks that the benchmark runs; its figures are meaningless"


def benchmark_parser(name: str, text: str | None, **quick: Any) -> QuickParser:
    """Return a parser with ``--quick`` and ``--json``. text: the module's docstring; quick: defaults of ``--quick``."""
    parser = QuickParser(
        prog=f"python -m physgen.benchmarks.{name}",
        description=text,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.quick = quick
    parser.add_argument("--quick", action="store_true", help=QUICK_HELP)
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    return parser


class QuickParser(argparse.ArgumentParser):
    """A parser whose defaults are others with ``--quick``; given options still win."""

    quick: dict[str, Any]

    def parse_args(self, args: Any = None, namespace: Any = None) -> Any:
        """Parse, with the defaults of ``--quick`` if it is given."""
        given = list(sys.argv[1:] if args is None else args)
        if "--quick" in given:
            self.set_defaults(**self.quick)
        return super().parse_args(given, namespace)


@contextlib.contextmanager
def blender_output_to_stderr() -> Iterator[None]:
    """Redirect what Blender's C code prints to standard error, so that standard output has the results only."""
    sys.stdout.flush()
    kept = os.dup(1)
    os.dup2(2, 1)
    try:
        yield
    finally:
        os.dup2(kept, 1)
        os.close(kept)


def print_result(result: Mapping[str, Any], *, as_json: bool) -> None:
    """Print a flat result: one JSON object, or a line for each value."""
    print(json.dumps(result) if as_json else "\n".join(f"{name:20} {value}" for name, value in result.items()))


def write_bake(
    folder: Path, caches: Mapping[str, Iterable[NDArray[np.floating]]], *, space: str = "world"
) -> BakeManifest:
    """Write a complete bake into the new ``folder``. caches: by object name, vertices (V, 3) of each frame."""
    folder.mkdir(parents=True)
    baked, frames = [], 0
    for name, samples in caches.items():
        writer = None
        for sample in samples:
            writer = writer or Pc2Writer(folder / f"{name}.pc2", vertex_count=len(sample))
            writer.append(sample)
        assert writer is not None, f"{name} has no frames"
        writer.close()
        frames = writer.sample_count
        baked.append(BakedObject(name=name, file=f"{name}.pc2", vertices=writer.vertex_count, space=space))
    manifest = BakeManifest(
        inputs_hash="0",
        fps=24.0,
        frame_start=1,
        frames=frames,
        frames_done=frames,
        state="complete",
        engine="benchmark",
        version=VERSION,
        particles=1,
        objects=tuple(baked),
    )
    save_manifest(folder, manifest)
    return manifest
