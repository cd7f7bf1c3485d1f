# SPDX-License-Identifier: MIT
"""Photo → objects worth reconstructing, without a box: a list, and a numbered picture of them."""

from __future__ import annotations

import io
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from ..atomic import write_bytes, write_json
from ..errors import InputError
from ..events import IsCancelled, OnEvent, ignore, never
from ..folder_lock import lock_beside
from ..reconstruct.reconstruct_options import WITHOUT, Proposal
from ..scene.folder import file_hash
from ..trust import trusted_spec
from ..validation import parse, read_json, to_json

if TYPE_CHECKING:
    from ..reconstruct.photo import Photo

FORMAT = "physgen-proposals/1"
LIST_FILE, PICTURE_FILE = "proposals.json", "proposals.jpg"
REVISION = 19
"""Raised with every change that changes which objects are proposed."""
SEARCHED = 1024
"""Longest side in pixels of the photo as it is read; the search itself needs less."""


@dataclass(frozen=True, kw_only=True)
class ProposalRecord:
    """``proposals.json``: the objects found in a photo, best first; boxes in pixels of the upright photo.

    segmenter: the model that found them, or ``none``.
    """

    format: str = FORMAT
    revision: int = REVISION
    photo: str
    photo_hash: str
    segmenter: str = WITHOUT
    width: int
    height: int
    proposals: tuple[Proposal, ...]


def _write(out: Path, record: ProposalRecord, picture: bytes) -> None:
    """Write the list and its ``picture``, a JPEG file, into ``out``: those of one photo, not of two."""
    with lock_beside(out):
        write_bytes(out / PICTURE_FILE, picture)
        write_json(out / LIST_FILE, to_json(record))


def propose(
    photo: str | Path,
    *,
    out: str | Path | None = None,
    segmenter: str | None = None,
    on_event: OnEvent = ignore,
    cancelled: IsCancelled = never,
) -> tuple[Proposal, ...]:
    """Return the objects of ``photo`` that stand out, best first: at most 20, each with a box and a score from 0 to 1.

    out: folder for ``proposals.jpg``, the photo with their numbers, and ``proposals.json``; None writes nothing. The
    same photo is not searched twice into the same folder. segmenter: a model that gives opacities, as IS-Net
    (``isnet``), whose objects come first; None finds them without learned weights, other models are not asked.

    >>> import physgen
    >>> found = physgen.propose("photo.jpg", out="proposals")  # doctest: +SKIP
    >>> cup = physgen.ObjectRequest(box=found[0].box)  # doctest: +SKIP

    Raises InputError for an unreadable photo, for a model that cannot be used, and where nothing stands out, Cancelled
    when cancelled; nothing is written then.
    """
    photo = Path(photo)
    if not photo.is_file():
        raise InputError(f"{photo}: there is no such photo; check its name")
    content = file_hash(photo)
    if out is not None:
        earlier = _earlier(Path(out), content, segmenter or WITHOUT)
        if earlier is not None:
            return earlier
    # The pipeline's modules cost a second of imports that an up-to-date list does not need, and Blender has no Pillow.
    from ..reconstruct.adapters.protocols import SoftSegmenter
    from ..reconstruct.adapters.resolve import resolve
    from ..reconstruct.photo import load_photo
    from ..reconstruct.segmentation.object_proposals import proposals_from_alpha, propose_boxes, with_model
    from ..reconstruct.stage_cache import Steps

    steps = Steps(2, on_event, cancelled, stage="propose")
    steps.begin("photo")
    picture = load_photo(photo, SEARCHED)
    steps.begin("propose objects")
    seen = propose_boxes(picture.pixels)
    cutter = None if segmenter is None else resolve("segmenter", trusted_spec(segmenter), cancelled)
    if isinstance(cutter, SoftSegmenter):
        alpha = cutter.alpha(picture.pixels, (0, 0, picture.width, picture.height))
        seen = with_model(proposals_from_alpha(alpha), seen, LEAST_CHOSEN)
    found = tuple(
        Proposal(tuple(round(v / picture.scale) for v in item.box), item.score)  # type: ignore[arg-type]
        for item in seen
    )
    if not found:
        raise InputError(f"{photo}: no object stands out in it; draw a box around each one (--box x0,y0,x1,y1)")
    steps.finish()
    if out is not None:
        width, height = picture.original_size
        record = ProposalRecord(
            photo=str(photo.resolve()),
            photo_hash=content,
            segmenter=segmenter or WITHOUT,
            width=width,
            height=height,
            proposals=found,
        )
        _write(Path(out), record, _numbered_picture(picture, found))
    return found


def _numbered_picture(picture: Photo, found: Sequence[Proposal]) -> bytes:
    """Return a JPEG file of the photo as it was searched, with the numbers of what was ``found``."""
    from PIL import Image

    from ..reconstruct.report_pictures import numbered_boxes

    boxes = [tuple(v * picture.scale for v in item.box) for item in found]
    file = io.BytesIO()
    shown = numbered_boxes(picture.pixels, boxes, best_proposals(found))
    Image.fromarray(shown).save(file, format="JPEG", quality=90)
    return file.getvalue()


def _earlier(folder: Path, content: str, segmenter: str) -> tuple[Proposal, ...] | None:
    """The proposals in ``folder`` for a photo with the hash ``content`` by ``segmenter``; None without any."""
    try:
        record = parse(ProposalRecord, read_json(folder / LIST_FILE), LIST_FILE)
    except InputError:
        return None
    found = (record.format, record.revision, record.photo_hash, record.segmenter)
    same = found == (FORMAT, REVISION, content, segmenter)
    return record.proposals if same and record.proposals and (folder / PICTURE_FILE).is_file() else None


LEAST_CHOSEN, BELOW_BEST, MOST_CHOSEN = 0.8, 0.1, 3
"""Score below which a proposal is not used unless it is the best, or the user says so; how much worse than the best
those are that are used too; how many are used."""
LEAST_CLEAR = 0.89
"""Score of the best proposal below which colours alone tell no object from a pattern. Of 79 photos of things the best
had 0.90 or more but for a rocket in flight; of seven of grass, gravel, bricks, clouds, a gradient and noise 0.88 or
less."""


def best_proposals(found: Sequence[Proposal]) -> list[int]:
    """Return the indices of the proposals, best first, with which to go on when the user says nothing."""
    if not found:
        return []
    least = max(LEAST_CHOSEN, found[0].score - BELOW_BEST)
    return [i for i, item in enumerate(found) if item.score >= least][:MOST_CHOSEN] or [0]


def choose(found: Sequence[Proposal], picked: Sequence[int], least: int, *, least_clear: float = 0.0) -> list[int]:
    """Return the indices of the proposals to go on with: the numbers ``picked`` (from 1), else the best.

    least: number of objects that the request speaks of; 0 for any. least_clear: score that the best must have where the
    request speaks of none. Raises InputError where it is lower, and for a number that is not there or comes twice.
    """
    if not picked:
        if least == 0 and found and found[0].score < least_clear:
            raise InputError(
                f"no object stands out clearly from the photo's pattern (best score {found[0].score:.2f}, "
                f"{least_clear:g} needed); draw a box around each one, --box x0,y0,x1,y1, or go on with --pick 1"
            )
        return best_proposals(found) if least == 0 else list(range(min(least, len(found))))
    for number in picked:
        if not 1 <= number <= len(found) or list(picked).count(number) > 1:
            raise InputError(f"--pick {number}: give numbers from 1 to {len(found)}, each once")
    return [number - 1 for number in picked]
