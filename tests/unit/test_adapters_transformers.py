# SPDX-License-Identifier: MIT
"""SAM, SAM 2, Depth Anything and Depth Pro: tiny ones with random weights, written by the library itself.

What random weights answer means nothing; that boxes, sizes, colours and focal lengths arrive where they should does.
"""

import argparse
import hashlib
import http.server
import json
import math
import socket
import threading
from pathlib import Path
from typing import ClassVar

import numpy as np
import pytest
from physgen.batch.cli import main
from physgen.batch.commands.flags import add_reconstruction_flags, reconstruct_options
from physgen.sim.errors import InputError
from physgen.sim.reconstruct.adapters import resolve
from physgen.sim.reconstruct.adapters.adapter_registry import list_adapters, named_adapters, spec_files
from physgen.sim.reconstruct.models.model_folder import VARIABLE

BOXES = np.array([[10.0, 20, 90, 80], [60, 5, 150, 95]])


@pytest.fixture(scope="module")
def library():
    """transformers, without a way into the network."""
    torch = pytest.importorskip("torch", reason="optional extra models: torch is not installed")
    transformers = pytest.importorskip("transformers", reason="optional extra models: transformers is not installed")
    torch.manual_seed(3)
    with pytest.MonkeyPatch.context() as patch:

        def refuse(*_, **__):
            raise AssertionError("the network was used")

        patch.setattr(socket.socket, "connect", refuse)
        yield transformers


def sam(transformers):
    config = transformers.SamConfig(
        vision_config={
            "hidden_size": 16,
            "output_channels": 16,
            "num_hidden_layers": 1,
            "num_attention_heads": 2,
            "image_size": 64,
            "patch_size": 8,
            "mlp_dim": 16,
            "window_size": 4,
            "num_pos_feats": 8,
            "global_attn_indexes": [0],
        },
        prompt_encoder_config={"hidden_size": 16, "image_size": 64, "patch_size": 8, "image_embedding_size": 8},
        mask_decoder_config={"hidden_size": 16, "mlp_dim": 16, "num_attention_heads": 2, "iou_head_hidden_dim": 16},
    )
    return transformers.SamModel(config)


def sam2(transformers):
    stages = {"blocks_per_stage": [1, 1, 1, 1], "embed_dim_per_stage": [8, 16, 32, 64]}
    backbone = transformers.Sam2HieraDetConfig(
        hidden_size=8, image_size=[128, 128], num_attention_heads_per_stage=[1, 1, 2, 2], **stages
    )
    vision = transformers.Sam2VisionConfig(
        backbone_config=backbone,
        backbone_channel_list=[64, 32, 16, 8],
        backbone_feature_sizes=[[32, 32], [16, 16], [8, 8]],
        fpn_hidden_size=16,
    )
    prompt = {"hidden_size": 16, "image_size": 128, "patch_size": 16, "mask_input_channels": 4}
    decoder = {"hidden_size": 16, "mlp_dim": 16, "num_attention_heads": 2, "iou_head_hidden_dim": 16}
    config = transformers.Sam2Config(vision_config=vision, prompt_encoder_config=prompt, mask_decoder_config=decoder)
    return transformers.Sam2Model(config)


def depth_anything(transformers, **changes):
    backbone = transformers.Dinov2Config(
        image_size=28,
        patch_size=14,
        hidden_size=8,
        num_hidden_layers=2,
        num_attention_heads=2,
        out_indices=[1, 2],
        reshape_hidden_states=False,
    )
    config = transformers.DepthAnythingConfig(
        backbone_config=backbone,
        reassemble_hidden_size=8,
        patch_size=14,
        neck_hidden_sizes=[4, 4],
        reassemble_factors=[4, 2],
        fusion_hidden_size=8,
        head_hidden_size=4,
        **changes,
    )
    return transformers.DepthAnythingForDepthEstimation(config)


def depth_pro(transformers):
    def vit(kind, hidden, patch):
        return {
            "model_type": kind,
            "num_hidden_layers": 2,
            "hidden_size": hidden,
            "num_attention_heads": 2,
            "intermediate_size": 16,
            "patch_size": patch,
        }

    config = transformers.DepthProConfig(
        patch_size=16,
        fusion_hidden_size=16,
        intermediate_hook_ids=[1, 0],
        intermediate_feature_dims=[10, 8],
        scaled_images_ratios=[0.5, 1.0],
        scaled_images_overlap_ratios=[0.0, 0.2],
        scaled_images_feature_dims=[12, 12],
        use_fov_model=True,
        image_model_config=vit("dinov2", 16, 4),
        patch_model_config=vit("dinov2", 16, 4),
        fov_model_config=vit("dinov2", 16, 4),
    )
    return transformers.DepthProForDepthEstimation(config)


MAKERS = {"sam": sam, "sam2": sam2, "depth-anything": depth_anything, "depth-pro": depth_pro}


@pytest.fixture(scope="module")
def weights(library, tmp_path_factory):
    """A folder with a folder of weights for each of them."""
    root = tmp_path_factory.mktemp("weights")
    for name, make in MAKERS.items():
        make(library).eval().save_pretrained(root / name)
    return root


def picture(width=160, height=100):
    y, x = np.mgrid[:height, :width]
    return np.stack([x * 255 // width, y * 255 // height, (x + y) % 256], axis=-1).astype(np.uint8)


@pytest.mark.parametrize("kind", ["sam", "sam2"])
def test_a_mask_for_each_box_at_the_photo_s_size(weights, kind):
    segmenter = resolve("segmenter", f"{kind}:{weights / kind}")
    pixels = picture()
    # What the network answers is replaced by its opposite where it finds nothing, so that both ends are seen.
    for sign in (1.0, -1.0):
        answers = []
        run = type(segmenter).run

        def answered(self, run=run, sign=sign, answers=answers, **given):
            answer = run(self, **given)
            answer.pred_masks = answer.pred_masks * 0 + sign
            answers.append(given)
            return answer

        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(type(segmenter), "run", answered)
            if sign < 0:
                with pytest.raises(InputError, match="found nothing in the box 10,20,90,80"):
                    segmenter(pixels, BOXES)
                continue
            masks = segmenter(pixels, BOXES)
        assert masks.shape == (2, 100, 160) and masks.dtype == bool and masks.all()
        side = segmenter.side
        scale = np.array([side / 160, side / 160 if kind == "sam" else side / 100] * 2)
        assert np.allclose(answers[0]["input_boxes"].numpy()[0], BOXES * scale, atol=1e-3)
        planes = answers[0]["pixel_values"].numpy()
        assert planes.shape == (1, 3, side, side)
        # SAM's padding is 0 once normalised.
        assert (planes[0, :, -1] == 0).all() == (kind == "sam")


def test_sam_sees_what_its_own_processor_shows_it(library, weights):
    """transformers' processor as an independent implementation of size, colours and boxes."""
    try:
        processor = library.SamProcessor(
            library.SamImageProcessor(size={"longest_edge": 64}, pad_size={"height": 64, "width": 64})
        )
        theirs = processor(images=picture(), input_boxes=[BOXES.tolist()], return_tensors="pt")
    except (ImportError, AttributeError, TypeError) as error:
        pytest.skip(f"its processor needs more than is installed: {error}")
    segmenter, seen = resolve("segmenter", f"sam:{weights / 'sam'}"), {}

    def keep(self, **given):
        seen.update(given)
        raise InputError("seen")

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(type(segmenter), "run", keep)
        with pytest.raises(InputError, match="seen"):
            segmenter(picture(), BOXES)
    assert np.allclose(seen["input_boxes"].numpy(), theirs["input_boxes"].numpy(), atol=0.5)
    # Filters differ at edges: one grey value is 0.017.
    assert np.abs(seen["pixel_values"].numpy() - theirs["pixel_values"].numpy()).mean() < 0.05


def test_depth_anything_gives_inverse_depth_or_metres(library, weights, tmp_path):
    depth = resolve("depth_estimator", f"depth-anything:{weights / 'depth-anything'}")(picture())
    assert depth.values.shape == (100, 160) and depth.meaning == "inverse" and depth.focal_px is None
    model = depth_anything(library, depth_estimation_type="metric", max_depth=20)
    model.eval().save_pretrained(tmp_path / "metric")
    adapter = resolve("depth_estimator", f"depth-anything:{tmp_path / 'metric'}")
    run = type(adapter).run

    def answered(self, **given):
        answer = run(self, **given)
        # Random weights see half of the largest depth everywhere, which is refused as nonsense.
        assert answer.predicted_depth.shape[-2:] == given["pixel_values"].shape[-2:]
        answer.predicted_depth = answer.predicted_depth * self.torch.linspace(
            0.5, 1.5, answer.predicted_depth.shape[-1]
        )
        return answer

    with pytest.raises(InputError, match="same depth everywhere"):
        adapter(picture())
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(type(adapter), "run", answered)
        metric = adapter(picture())
    assert metric.meaning == "metric" and np.nanmin(metric.values) > 0 and np.nanmax(metric.values) <= 20


def test_depth_pro_scales_with_the_focal_length(weights):
    """As its processor has it: depth = focal length / (width × canonical inverse depth)."""
    adapter = resolve("depth_estimator", f"depth-pro:{weights / 'depth-pro'}")
    run = type(adapter).run
    torch = adapter.torch

    def answered(self, **given):
        assert given["pixel_values"].shape == (1, 3, 32, 32)
        answer = run(self, **given)
        assert answer.field_of_view is not None and answer.predicted_depth.ndim == 3
        # Random weights see no camera: 90° make the focal length half of the width.
        answer.field_of_view = torch.tensor([90.0])
        answer.predicted_depth = torch.linspace(0.5, 2.0, 64).repeat(64, 1)[None]
        return answer

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(type(adapter), "run", answered)
        depth = adapter(picture())
    assert depth.meaning == "metric" and depth.focal_px == pytest.approx(80.0)
    assert depth.values[50, 0] == pytest.approx(0.5 / 0.5, rel=0.02)
    assert depth.values[50, -1] == pytest.approx(0.5 / 2.0, rel=0.02)


@pytest.mark.parametrize("kind", MAKERS)
def test_numbers_that_are_none_are_told(library, weights, tmp_path, kind):
    torch = pytest.importorskip("torch")
    model = MAKERS[kind](library)
    with torch.no_grad():
        for parameter in model.parameters():
            parameter.fill_(math.nan)
    model.save_pretrained(tmp_path / kind)
    stage = "segmenter" if kind.startswith("sam") else "depth_estimator"
    adapter = resolve(stage, f"{kind}:{tmp_path / kind}")
    with pytest.raises(InputError, match=kind):
        adapter(picture(), BOXES) if stage == "segmenter" else adapter(picture())


def test_weights_of_another_size_or_none_are_told(library, weights, tmp_path):
    from safetensors.numpy import load_file, save_file

    folder = tmp_path / "sam"
    folder.mkdir()
    config = (weights / "sam" / "config.json").read_text()
    (folder / "config.json").write_text(config)
    with pytest.raises(InputError, match=r"no \.safetensors weights"):
        resolve("segmenter", f"sam:{folder}")
    (folder / "pytorch_model.bin").write_bytes(b"\x80\x04.")
    with pytest.raises(InputError, match="is a pickle"):
        resolve("segmenter", f"sam:{folder}")
    content = load_file(weights / "sam" / "model.safetensors")
    content.pop(next(iter(content)))
    save_file(content, folder / "model.safetensors", metadata={"format": "pt"})
    with pytest.raises(InputError, match="lack 1 of the model's tensors"):
        resolve("segmenter", f"sam:{folder}")


def test_folders_are_checked_without_the_library(tmp_path):
    with pytest.raises(InputError, match="there is no folder"):
        resolve("segmenter", f"sam2:{tmp_path / 'none'}")
    with pytest.raises(InputError, match=r"has no config\.json"):
        resolve("segmenter", f"sam2:{tmp_path}")
    (tmp_path / "config.json").write_text(json.dumps({"model_type": "bert"}))
    with pytest.raises(InputError, match="weights of the type 'bert', expected sam2"):
        resolve("segmenter", f"sam2:{tmp_path}")
    with pytest.raises(InputError, match="is a segmenter, not a depth_estimator"):
        resolve("depth_estimator", f"sam2:{tmp_path}")
    with pytest.raises(InputError, match="--weights DIR"):
        resolve("segmenter", "sam2")


def read(*words):
    parser = argparse.ArgumentParser()
    add_reconstruction_flags(parser)
    return reconstruct_options(parser.parse_args(list(words)))


def test_the_command_line_names_models_and_their_weights(tmp_path, monkeypatch):
    for name in ("sam2", "depth-anything"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "model.safetensors").write_bytes(b"")
        (tmp_path / name / "config.json").write_text(json.dumps({"model_type": name.replace("-", "_")}))
    options = read("--segmenter", "sam2", "--depth", "depth-anything", "--weights", str(tmp_path))
    assert options.segmenter == f"sam2:{(tmp_path / 'sam2').resolve()}" and options.depth is None
    assert options.depth_estimator == f"depth-anything:{(tmp_path / 'depth-anything').resolve()}"
    assert spec_files("segmenter", options.segmenter) == [(tmp_path / "sam2").resolve() / "config.json"]
    assert read("--depth", "map.npy").depth == Path("map.npy")
    assert read("--segmenter", "sam2", "--weights", str(tmp_path / "sam2")).segmenter.endswith("/sam2")
    with pytest.raises(InputError, match="--weights: is for"):
        read("--segmenter", "isnet", "--weights", str(tmp_path))
    with pytest.raises(InputError, match="give one of them"):
        read("--depth", "depth-pro", "--depth-estimator", "mine")
    # In the folder of models they need no --weights.
    monkeypatch.setenv(VARIABLE, str(tmp_path))
    assert {("segmenter", "sam2"), ("depth_estimator", "depth-anything")} <= {
        (a.stage, a.name) for a in list_adapters()
    }


class Hub(http.server.BaseHTTPRequestHandler):
    """Two files of one repository, as the hub serves them; nothing else is there."""

    files: ClassVar[dict] = {"config.json": b'{"model_type": "sam2"}', "model.safetensors": bytes(range(256)) * 9}
    asked: ClassVar[list] = []

    def do_HEAD(self):
        self.asked.append(self.path)
        content = self.files.get(self.path.rpartition("/resolve/main/")[2])
        self.send_response(404 if content is None else 200)
        if content is not None:
            self.send_header("X-Repo-Commit", "a" * 40)
            self.send_header("ETag", f'"{hashlib.sha256(content).hexdigest()}"')
            self.send_header("Content-Length", str(len(content)))
        self.end_headers()
        return content

    def do_GET(self):
        content = self.do_HEAD()
        if content is not None:
            self.wfile.write(content)

    def log_message(self, *_):
        pass


def test_weights_are_fetched_after_agreement_only(tmp_path, monkeypatch, capfd):
    pytest.importorskip("huggingface_hub", reason="optional extra models: huggingface_hub is not installed")
    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), Hub)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    monkeypatch.setenv("HF_ENDPOINT", f"http://127.0.0.1:{server.server_port}")
    monkeypatch.setenv(VARIABLE, str(tmp_path / "models"))
    try:
        assert main(["models", "install", "sam2"]) == 3
        told = capfd.readouterr().out
        assert "Apache-2.0" in told and "MB" in told and not Hub.asked and not (tmp_path / "models").exists()
        assert main(["models", "install", "sam2", "--yes"]) == 0
        folder = tmp_path / "models" / "sam2"
        assert sorted(p.name for p in folder.iterdir()) == sorted(Hub.files)
        assert all((folder / name).read_bytes() == content for name, content in Hub.files.items())
        assert next(item.spec for item in named_adapters() if item.name == "sam2") == f"sam2:{folder}"
        monkeypatch.setitem(Hub.files, "model.safetensors", None)
        assert main(["models", "install", "sam2", "--yes"]) == 3
        assert "sam2: download" in capfd.readouterr().err
        # What was there stays.
        assert (folder / "model.safetensors").is_file() and len(list(folder.parent.iterdir())) == 1
        assert main(["models", "remove", "sam2"]) == 0 and not folder.exists()
    finally:
        server.shutdown()


def test_download_is_for_models_that_the_command_names(tmp_path, capfd):
    photo = tmp_path / "photo.png"
    photo.write_bytes(b"")
    words = ["reconstruct", str(photo), "--box", "1,1,9,9", "--out", str(tmp_path / "scene"), "--download"]
    assert main(words) == 3 and "name one by --segmenter, --depth or --inpainter" in capfd.readouterr().err
    assert main([*words, "--segmenter", "sam2", "--weights", str(tmp_path)]) == 3
    assert "without --weights" in capfd.readouterr().err
