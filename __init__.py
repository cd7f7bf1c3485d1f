# SPDX-License-Identifier: GPL-3.0-or-later
"""One photo becomes a small physical world; a recording tells where simulation and reality part.

    import physgen

    objects = [physgen.ObjectRequest(name="cup", box=(70, 12, 488, 392), preset="jelly", velocity=(0, 0, 0.6))]
    scene = physgen.reconstruct("presets/demo/coffee.jpg", objects, out="work/scene", on_event=print)
    bake = physgen.bake(scene, out="work/bake", options=physgen.BakeOptions(frames=48), on_event=print)
    frames = physgen.render(scene, bake, out="work/frames", video="video.mp4")

    capture = physgen.track(scene, ["recording.mp4"], out="work/capture")  # your own video of what the photo shows
    diagnosis = physgen.diagnose(capture, out="work/diagnosis")
    print(diagnosis.verdict.effect, diagnosis.summary)

Every name of ``__all__`` is loaded when it is first used: importing the package needs neither Blender nor Taichi, SciPy
or OpenCV. The same folder is a Blender extension; ``register`` and ``unregister`` are its entry.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from .batch.stages import export_alembic, render
    from .physgen_addon.render.render_options import RenderOptions
    from .sim.app.bake import bake
    from .sim.app.bake_options import BakeOptions
    from .sim.app.compose_scene import compose
    from .sim.app.default_motion import DefaultMotion, default_motion
    from .sim.app.diagnose import diagnose
    from .sim.app.evaluate import EvaluateOptions, evaluate
    from .sim.app.explain import Explanation, explain
    from .sim.app.export_usd import export_usd
    from .sim.app.import_capture import ImportRequest, import_capture
    from .sim.app.propose import propose
    from .sim.app.reconstruct import Physics, reconstruct
    from .sim.cache.bake_folder import Bake, load_bake
    from .sim.diagnose.capture import Capture
    from .sim.diagnose.capture_folder import load_capture
    from .sim.diagnose.diagnosis import Diagnosis
    from .sim.diagnose.run_diagnosis import DiagnoseOptions
    from .sim.diagnose.track.track_command import track
    from .sim.diagnose.track.track_input import BodyRequest, TrackOptions, VideoTrial
    from .sim.errors import PhysGenError
    from .sim.evaluate.evaluation import Evaluation
    from .sim.evaluate.questionnaire import QuestionnaireOptions, make_questionnaire
    from .sim.evaluate.questionnaire_answers import CollectOptions, collect_questionnaire
    from .sim.gaussians.compose.compose_options import ComposeRequest
    from .sim.importers.mesh_scene import scene_from_meshes
    from .sim.mpm.world import World
    from .sim.reconstruct.reasoning.chat_client import ChatRequest
    from .sim.reconstruct.reconstruct_options import ObjectRequest, Proposal, ReconstructOptions
    from .sim.scene.folder import Scene, load_scene
    from .sim.version import VERSION as __version__

__all__ = [
    "Bake",
    "BakeOptions",
    "BodyRequest",
    "Capture",
    "ChatRequest",
    "CollectOptions",
    "ComposeRequest",
    "DefaultMotion",
    "DiagnoseOptions",
    "Diagnosis",
    "EvaluateOptions",
    "Evaluation",
    "Explanation",
    "ImportRequest",
    "ObjectRequest",
    "PhysGenError",
    "Physics",
    "Proposal",
    "QuestionnaireOptions",
    "ReconstructOptions",
    "RenderOptions",
    "Scene",
    "TrackOptions",
    "VideoTrial",
    "World",
    "__version__",
    "bake",
    "collect_questionnaire",
    "compose",
    "default_motion",
    "diagnose",
    "evaluate",
    "explain",
    "export_alembic",
    "export_usd",
    "import_capture",
    "load_bake",
    "load_capture",
    "load_scene",
    "make_questionnaire",
    "propose",
    "reconstruct",
    "render",
    "scene_from_meshes",
    "track",
]

_HOMES = {
    "Bake": ".sim.cache.bake_folder",
    "BakeOptions": ".sim.app.bake_options",
    "BodyRequest": ".sim.diagnose.track.track_input",
    "Capture": ".sim.diagnose.capture",
    "ChatRequest": ".sim.reconstruct.reasoning.chat_client",
    "CollectOptions": ".sim.evaluate.questionnaire_answers",
    "ComposeRequest": ".sim.gaussians.compose.compose_options",
    "DefaultMotion": ".sim.app.default_motion",
    "DiagnoseOptions": ".sim.diagnose.run_diagnosis",
    "Diagnosis": ".sim.diagnose.diagnosis",
    "EvaluateOptions": ".sim.app.evaluate",
    "Evaluation": ".sim.evaluate.evaluation",
    "Explanation": ".sim.app.explain",
    "ImportRequest": ".sim.app.import_capture",
    "ObjectRequest": ".sim.reconstruct.reconstruct_options",
    "PhysGenError": ".sim.errors",
    "Physics": ".sim.app.reconstruct",
    "Proposal": ".sim.reconstruct.reconstruct_options",
    "QuestionnaireOptions": ".sim.evaluate.questionnaire",
    "ReconstructOptions": ".sim.reconstruct.reconstruct_options",
    "RenderOptions": ".physgen_addon.render.render_options",
    "Scene": ".sim.scene.folder",
    "TrackOptions": ".sim.diagnose.track.track_input",
    "VideoTrial": ".sim.diagnose.track.track_input",
    "World": ".sim.mpm.world",
    "bake": ".sim.app.bake",
    "collect_questionnaire": ".sim.evaluate.questionnaire_answers",
    "compose": ".sim.app.compose_scene",
    "default_motion": ".sim.app.default_motion",
    "diagnose": ".sim.app.diagnose",
    "evaluate": ".sim.app.evaluate",
    "explain": ".sim.app.explain",
    "export_alembic": ".batch.stages",
    "export_usd": ".sim.app.export_usd",
    "import_capture": ".sim.app.import_capture",
    "load_bake": ".sim.cache.bake_folder",
    "load_capture": ".sim.diagnose.capture_folder",
    "load_scene": ".sim.scene.folder",
    "make_questionnaire": ".sim.evaluate.questionnaire",
    "propose": ".sim.app.propose",
    "reconstruct": ".sim.app.reconstruct",
    "render": ".batch.stages",
    "scene_from_meshes": ".sim.importers.mesh_scene",
    "track": ".sim.diagnose.track.track_command",
}
"""Public name → module that defines it."""


def __getattr__(name: str) -> Any:
    """Load a public name on first use (PEP 562)."""
    if name == "__version__":
        return import_module(".sim.version", __name__).VERSION
    home = _HOMES.get(name)
    if home is None:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(import_module(home, __name__), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted([*__all__, "register", "unregister"])


def register() -> None:
    """Called by Blender when the extension is enabled."""
    from . import physgen_addon

    physgen_addon.register()


def unregister() -> None:
    """Called by Blender when the extension is disabled."""
    from . import physgen_addon

    physgen_addon.unregister()
