# SPDX-License-Identifier: MIT
"""People as judges: a folder of pages that shows videos side by side and saves what a person answers.

After PhysGen3D (supplement B.2, figure 3): a photo, the text, the videos in random order, three criteria on a
five-point scale. The pages need no server, load nothing from elsewhere and send nothing: the browser saves one file.
"""

from __future__ import annotations

import base64
import hashlib
import io
import json
import re
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from PIL import Image

from ..atomic import replacing_tree, write_bytes, write_json
from ..diagnose.track.video_file import Video
from ..errors import Cancelled, InputError
from ..events import IsCancelled, OnEvent, StageProgress, ignore, never
from ..files import is_file, open_file, read_toml, shown
from ..folder_lock import lock_beside
from ..html import Markup, page_head, render
from ..page_style import FONT, PALETTES
from ..srgb import read_rgb
from ..validation import quantity, read_json, require_quantities
from ..version import VERSION
from .judge_question import CRITERIA, MAX_PROMPT, MOST_VIDEOS, TITLES

CASE_FILE, KEY_FILE, PAGES = "case.toml", "key.json", "pages"
FORMAT, ANSWERS_FORMAT = "physgen questionnaire", "physgen questionnaire answers"
MOST_CASES = 100
MAX_CASE_BYTES = 2**16
MAX_VIDEO_BYTES = 2**29
NAME = re.compile(r"[^\W_][\w .+-]{0,59}\Z")
"""Of a video or case."""

STATEMENTS = {
    "physical_realism": "The video is physically realistic",
    "photorealism": "The video is photorealistic",
    "semantic_consistency": "The video does what the text says",
}
SCALE = ("Strongly disagree", "Disagree", "Neither", "Agree", "Strongly agree")
"""1 to 5."""

EXPLANATIONS = {
    "physical_realism": (
        "How well does the video follow the laws of physics: do things move, touch and give way as in reality, "
        "with the elasticity and friction of what they are made of? Special effects that the text asks for do "
        "not count against it. If nothing moves at all, give fewer points, even though stillness is realistic."
    ),
    "photorealism": (
        "How real does it look: are there artefacts or jumps, and are light, shadow, texture and material kept as in a "
        "real recording?"
    ),
    "semantic_consistency": (
        "How well does what happens agree with the text? Look above all at whether things move as it describes."
    ),
}
_SUFFIXES = {".mp4": b"ftyp", ".m4v": b"ftyp", ".webm": b"\x1a\x45\xdf\xa3"}
"""Formats that browsers play, with what such a file has among its first bytes."""

_PLAYED = ("h264", "avc1", "avc3", "vp80", "vp90", "av01")
"""Codecs that every present browser plays, as FFmpeg and containers name them; HEVC depends on the device."""

_PAGE, _START = (Path(__file__).with_name(f"questionnaire_{name}.html") for name in ("page", "start"))
_SCRIPT, _STYLE = (Path(__file__).with_name(f"questionnaire_page.{kind}") for kind in ("js", "css"))


@dataclass(frozen=True, kw_only=True)
class Case:
    """A photo, what should happen, and the videos of it.

    name: of the case. prompt: the text that people see. image: file of the photo. videos: name (of a method) → file.
    """

    name: str
    prompt: str
    image: Path
    videos: Mapping[str, Path]


@dataclass(frozen=True, kw_only=True)
class QuestionnaireOptions:
    """Options of a questionnaire. Raises InputError on a value out of range.

    title: of the pages, 1 to 120 characters. seed: of the anonymous names of the videos. image_size: longer side of the
    photo in pixels, 128 to 4096.
    """

    title: str = "How real do these videos look?"
    seed: int = quantity(0, 0, 2**31 - 1, "a whole number")
    image_size: int = quantity(1280, 128, 4096, "pixels")

    def __post_init__(self) -> None:
        require_quantities(self, "questionnaire option ")
        if not (len(self.title.strip()) > 0 and len(self.title) <= 120):
            raise InputError(f"questionnaire option title has {len(self.title)} characters: give 1 to 120")


def load_case(path: Path) -> Case:
    """Return the case of the file ``path``, or of ``case.toml`` in the folder ``path``.

    The file has ``prompt``, ``image`` and a table ``[videos]`` of file names by the name of the method; files lie in
    the folder of the case. Raises InputError for anything else, a file that is missing or leads out of that folder.
    """
    file = path / CASE_FILE if path.is_dir() else path
    try:
        values = read_toml(file, MAX_CASE_BYTES, what="case of a questionnaire")
    except FileNotFoundError:
        raise InputError(
            f"{shown(file)}: no such file; a case is a TOML file with prompt, image and [videos]"
        ) from None
    strange = sorted(set(values) - {"name", "prompt", "image", "videos"})
    if strange:
        raise InputError(
            f"{shown(file)}: {shown(strange[0])!r} is not known; a case has name, prompt, image and [videos]"
        )
    folder = file.parent
    name = values.get("name", folder.resolve().name if file.name == CASE_FILE else file.stem)
    if not (isinstance(name, str) and NAME.match(name)):
        raise InputError(
            f"{shown(file)}: name is {shown(str(name))!r}; give up to 60 letters, digits, spaces, . + - or _"
        )
    prompt = values.get("prompt")
    if not (isinstance(prompt, str) and prompt.strip() and len(prompt) <= MAX_PROMPT):
        raise InputError(f"{shown(file)}: prompt must be a text of 1 to {MAX_PROMPT} characters: what should happen")
    videos = values.get("videos")
    if not (isinstance(videos, dict) and 1 <= len(videos) <= MOST_VIDEOS):
        raise InputError(f"{shown(file)}: [videos] must name 1 to {MOST_VIDEOS} videos, as in ours = 'ours.mp4'")
    for video in videos:
        if not NAME.match(video):
            raise InputError(
                f"{shown(file)}: videos: {shown(video)!r} is no name; use letters, digits, spaces, . + - or _"
            )
    return Case(
        name=name,
        prompt=" ".join(prompt.split()),
        image=_beside(file, "image", values.get("image")),
        videos={video: _beside(file, f"videos.{video}", given) for video, given in videos.items()},
    )


def _beside(file: Path, field: str, given: object) -> Path:
    """The file ``given`` in the folder of ``file``."""
    if not isinstance(given, str) or not given or len(given) > 500 or "\0" in given:
        raise InputError(f"{shown(file)}: {field} must be the name of a file in the same folder")
    path = file.parent / given
    try:
        inside = path.resolve().is_relative_to(file.parent.resolve())
    except (OSError, RuntimeError, ValueError) as error:
        raise InputError(f"{shown(file)}: {field}: no file can be called that ({error})") from None
    if not inside:
        raise InputError(f"{shown(file)}: {field} leads out of the case's folder; put the file itself there")
    if not is_file(path):
        raise InputError(f"{shown(file)}: {field}: there is no file {shown(given)!r} in {shown(file.parent)}")
    return path


def make_questionnaire(
    cases: Sequence[str | Path | Case],
    *,
    out: str | Path,
    options: QuestionnaireOptions | None = None,
    on_event: OnEvent = ignore,
    cancelled: IsCancelled = never,
) -> Path:
    """Write a questionnaire about ``cases`` to the folder ``out`` and return the page to open first.

    ``out/pages`` is to be handed out: ``index.html``, one page for each case, photos and videos under names that do not
    tell the method. ``out/key.json`` says which video is which; keep it for ``collect_questionnaire``. An earlier
    questionnaire in ``out`` is replaced, anything else is not.

    Raises InputError for no cases, two of one name, an unusable file, and an ``out`` that holds something else;
    Cancelled.

    >>> import physgen
    >>> page = physgen.make_questionnaire(["cases/apple", "cases/cup"], out="questionnaire")  # doctest: +SKIP
    """
    options, out = options or QuestionnaireOptions(), Path(out)
    read = [case if isinstance(case, Case) else load_case(Path(case)) for case in cases]
    if not 1 <= len(read) <= MOST_CASES:
        raise InputError(f"questionnaire: {len(read)} cases given; give 1 to {MOST_CASES}")
    for i, case in enumerate(read):
        if case.name in [other.name for other in read[:i]]:
            raise InputError(f"questionnaire: two cases are called {case.name!r}; give one another name in its file")
    if out.is_dir() and any(out.iterdir()) and not (out / KEY_FILE).is_file():
        raise InputError(f"{shown(out)}: holds something other than a questionnaire; choose an empty or new folder")
    progress = StageProgress(on_event, "questionnaire", len(read))
    with lock_beside(out), replacing_tree(out) as folder:
        pages = folder / PAGES
        (pages / "media").mkdir(parents=True)
        described: list[dict[str, Any]] = []
        for number, case in enumerate(read, start=1):
            if cancelled():
                raise Cancelled("questionnaire cancelled")
            described.append(_media(case, number, pages / "media", options))
            progress.report(number)
        print_of = hashlib.sha256(json.dumps([options.title, described], sort_keys=True).encode()).hexdigest()[:16]
        for number in range(len(described) + 1):
            name = "index.html" if number == 0 else described[number - 1]["page"]
            write_bytes(pages / name, _page(number, described, print_of, options).encode())
        key = {
            "format": FORMAT,
            "version": 1,
            "made_by": VERSION,
            "questionnaire": print_of,
            "title": options.title,
            "criteria": list(CRITERIA),
            "cases": [{k: entry[k] for k in ("id", "name", "prompt", "videos")} for entry in described],
        }
        write_json(folder / KEY_FILE, key)
    return out / PAGES / "index.html"


def _media(case: Case, number: int, media: Path, options: QuestionnaireOptions) -> dict[str, Any]:
    """Copy what the case shows under anonymous names; return its entry of the key."""
    code = f"case_{number:02}"
    picture = Image.fromarray(read_rgb(case.image))
    picture.thumbnail((options.image_size, options.image_size), Image.Resampling.LANCZOS)
    data = io.BytesIO()
    picture.save(data, "JPEG", quality=90)
    # The name of a file must not tell whose it is; the same inputs give the same names.
    videos, files = {}, {}
    for name, path in case.videos.items():
        token = hashlib.sha256(f"{options.seed}/{case.name}/{name}/{_digest(path)}".encode()).hexdigest()[:10]
        _check_video(path)
        target = media / f"{code}_{token}{path.suffix.lower()}"
        shutil.copyfile(path, target)
        videos[token], files[token] = name, f"media/{target.name}"
    return {
        "id": code,
        "name": case.name,
        "prompt": case.prompt,
        # Sorted by the token, or the order in the page's source would be that of the file.
        "videos": dict(sorted(videos.items())),
        "files": dict(sorted(files.items())),
        "page": f"{code}.html",
        "image": base64.b64encode(data.getvalue()).decode("ascii"),
        "size": list(picture.size),
    }


def _digest(path: Path) -> str:
    with open_file(path, MAX_VIDEO_BYTES, what="video of a questionnaire") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def _check_video(path: Path) -> None:
    """Raise InputError unless browsers can be expected to play ``path``, and it has more than one frame."""
    suffix = path.suffix.lower()
    if suffix not in _SUFFIXES:
        raise InputError(f"{shown(path)}: browsers play MP4 (H.264) and WebM; convert it")
    with open_file(path, MAX_VIDEO_BYTES, what="video of a questionnaire") as stream:
        if _SUFFIXES[suffix] not in stream.read(16):
            raise InputError(f"{shown(path)}: is no {suffix[1:].upper()} file, whatever its name says; convert it")
    with Video(path) as video:
        codec, frames = video.info.codec, sum(1 for _ in video.frames(0, 1))
    if codec and codec not in _PLAYED:
        raise InputError(f"{shown(path)}: is encoded as {codec!r}; browsers play H.264, VP8, VP9 and AV1; convert it")
    if frames < 2:
        raise InputError(f"{shown(path)}: has {frames or 'no'} readable frame; give a video that shows motion")


def _page(number: int, cases: list[dict[str, Any]], print_of: str, options: QuestionnaireOptions) -> str:
    """The page of case ``number`` from 1; 0 is the first page."""
    case = cases[number - 1] if number else None
    script, style = _SCRIPT.read_text(encoding="utf-8"), _style()
    shared = {
        "head": page_head(options.title, style, script=script),
        "title": options.title,
        "script": Markup(script),
        "count": len(cases),
        "criteria": [(name, TITLES[name], STATEMENTS[name], EXPLANATIONS[name]) for name in CRITERIA],
        "data": _script_data(
            {
                "format": ANSWERS_FORMAT,
                "questionnaire": print_of,
                "criteria": list(CRITERIA),
                "cases": {entry["id"]: list(entry["videos"]) for entry in cases},
                "pages": ["index.html", *(entry["page"] for entry in cases)],
                "page": number,
            }
        ),
    }
    if case is None:
        return render(_START, **shared)
    return render(
        _PAGE,
        **shared,
        case=case,
        number=number,
        scale=list(enumerate(SCALE, start=1)),
        image=Markup(f"data:image/jpeg;base64,{case['image']}"),
    )


def _script_data(values: dict[str, Any]) -> Markup:
    """``values`` as JSON that no script element can be left by."""
    return Markup(json.dumps(values).replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026"))


def _style() -> str:
    chosen = ("paper", "panel", "ink", "quiet", "rule", "found", "found-tint", "nominal")
    variables = {
        theme: ":root{" + "".join(f"--{name}:{PALETTES[theme][name]};" for name in chosen) + "}" for theme in PALETTES
    }
    plain = _STYLE.read_text(encoding="utf-8")
    dark = f"@media (prefers-color-scheme:dark){{{variables['dark']}}}"
    return f"{variables['light']}{dark}body{{font-family:{FONT}}}{plain}"


def load_key(path: Path) -> dict[str, Any]:
    """Return the content of a questionnaire's ``key.json``. Raises InputError for anything else."""
    file = path / KEY_FILE if path.is_dir() else path
    key = read_json(file)
    good = isinstance(key, dict) and key.get("format") == FORMAT and key.get("version") == 1
    if not good or not isinstance(key.get("questionnaire"), str) or key.get("criteria") != list(CRITERIA):
        raise InputError(f"{shown(file)}: is not the key of a questionnaire; give key.json of the folder that was made")
    cases = key.get("cases")
    if not isinstance(cases, list) or not 1 <= len(cases) <= MOST_CASES or not all(_is_case(case) for case in cases):
        raise InputError(f"{shown(file)}: cases are damaged; give the key as it was written")
    if len({case["id"] for case in cases}) < len(cases) or len({case["name"] for case in cases}) < len(cases):
        raise InputError(f"{shown(file)}: two cases have one name; give the key as it was written")
    return key


def _is_case(case: object) -> bool:
    if not isinstance(case, dict) or not isinstance(case.get("videos"), dict):
        return False
    videos = case["videos"]
    named = all(isinstance(v, str) and NAME.match(v) for v in (*videos.values(), case.get("id"), case.get("name")))
    return named and 1 <= len(videos) <= MOST_VIDEOS and len(set(videos.values())) == len(videos)
