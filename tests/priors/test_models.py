"""Named networks (finding, checksums, cache) and the running of ONNX files."""

import hashlib
import http.server
import logging
import shutil
import threading
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from onnx import TensorProto, helper

from factorsfm.priors import models
from factorsfm.priors.networks import NETWORK_SPECS, Network, NetworkSpec, network_family
from factorsfm.support.errors import ModelError
from tests.networks import save_network

NAME = "tcmonodepth"
FILE = models.MODELS[NAME].file


@pytest.fixture
def cache(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """An empty cache, no FACTORSFM_MODELS, and nothing to fetch from."""
    folder = tmp_path / "cache"
    monkeypatch.setattr(models, "cache_folder", lambda: folder)
    monkeypatch.delenv("FACTORSFM_MODELS", raising=False)
    point_to(monkeypatch, "http://127.0.0.1:9/")
    return folder


def point_to(monkeypatch: pytest.MonkeyPatch, root: str) -> None:
    monkeypatch.setitem(models.MODELS, NAME, replace(models.MODELS[NAME], url=root + FILE))


@pytest.fixture
def server(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A folder that the named network is fetched from, over HTTP."""
    folder = tmp_path / "origin"
    folder.mkdir()

    class Handler(http.server.SimpleHTTPRequestHandler):
        def __init__(self, *args: object) -> None:
            super().__init__(*args, directory=str(folder))  # type: ignore[arg-type]

        def log_message(self, *args: object) -> None:
            pass

    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), Handler) as running:
        threading.Thread(target=running.serve_forever, args=(0.01,), daemon=True).start()
        monkeypatch.setenv("NO_PROXY", "127.0.0.1")
        point_to(monkeypatch, f"http://127.0.0.1:{running.server_port}/")
        yield folder
        running.shutdown()


def test_models_folder_is_used_first(cache: Path, shared_models: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    cache.mkdir()
    (cache / FILE).write_bytes(b"never looked at")
    monkeypatch.setenv("FACTORSFM_MODELS", str(shared_models))
    assert models.find_model(NAME) == shared_models / FILE


def test_cache_is_used_where_the_models_folder_lacks_the_file(
    cache: Path, shared_models: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    cache.mkdir()
    shutil.copy(shared_models / FILE, cache / FILE)
    assert models.find_model(NAME) == cache / FILE
    monkeypatch.setenv("FACTORSFM_MODELS", str(tmp_path))
    assert models.find_model(NAME) == cache / FILE


def test_corrupted_file_is_refused(cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    cache.mkdir()
    (cache / FILE).write_bytes(b"half a downl")
    digest = hashlib.sha256(b"half a downl").hexdigest()
    message = f"cache/{FILE} is not the network tcmonodepth: .*{digest[:12]}.*expected 902b886beaeb"
    with pytest.raises(ModelError, match=message):
        models.find_model(NAME)
    monkeypatch.setenv("FACTORSFM_MODELS", str(cache))
    with pytest.raises(ModelError, match=message):
        models.find_model(NAME)


def test_models_folder_must_exist(cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("FACTORSFM_MODELS", "/nowhere/at/all")
    with pytest.raises(ModelError, match="FACTORSFM_MODELS must name a folder of networks, not /nowhere"):
        models.find_model(NAME)


def test_without_network_the_message_says_what_to_do(cache: Path) -> None:
    started = time.monotonic()
    with pytest.raises(ModelError) as caught:
        models.find_model(NAME)
    assert time.monotonic() - started < 5.0
    message = str(caught.value)
    assert "\n" not in message
    assert f"set FACTORSFM_MODELS to a folder that holds {FILE}" in message
    assert "--depth FILE or --depth none" in message
    assert not list(cache.glob("*"))


def test_a_network_without_a_source_says_where_its_file_belongs(cache: Path) -> None:
    with pytest.raises(ModelError) as caught:
        models.find_model("deeplab")
    message = str(caught.value)
    assert "\n" not in message
    assert f"put {models.MODELS['deeplab'].file} (SHA-256 e80797f7dd32...)" in message
    assert f"into the folder that FACTORSFM_MODELS names or into {cache}" in message
    assert "pass --masks FILE.onnx" in message


def test_named_network_is_fetched_once(cache: Path, server: Path, shared_models: Path) -> None:
    shutil.copy(shared_models / FILE, server / FILE)
    assert models.find_model(NAME) == cache / FILE
    assert (cache / FILE).read_bytes() == (shared_models / FILE).read_bytes()
    (server / FILE).unlink()
    assert models.find_model(NAME) == cache / FILE


@pytest.mark.parametrize("content", [b"something else", None])
def test_wrong_or_missing_file_at_the_origin_leaves_no_trace(cache: Path, server: Path, content: bytes | None) -> None:
    if content is not None:
        (server / FILE).write_bytes(content)
    with pytest.raises(ModelError, match="could not be fetched"):
        models.find_model(NAME)
    assert not list(cache.glob("*"))


def test_unknown_file_or_name() -> None:
    with pytest.raises(ModelError, match="no network moonodepth; expected an ONNX file or one of: tcmonodepth"):
        models.find_model("moonodepth")


@pytest.mark.parametrize(
    ("name", "family"),
    [
        ("tcmonodepth_tcsmallnet_192x320.onnx", "tcmonodepth"),
        ("fast_depth_224_fp32.onnx", "fastdepth"),
        ("Depth-Anything-V2-Small.onnx", "depth_anything"),
        ("depthanything.vits14.onnx", "depth_anything"),
        ("midas_v3_dpt_large.onnx", "dpt"),
        ("MiDaS_small.onnx", "midas"),
        ("deeplabv3_mnv2.onnx", "deeplab"),
        ("adpt.onnx", None),
        ("model.onnx", None),
    ],
)
def test_family_by_file_name(name: str, family: str | None) -> None:
    assert network_family(Path(name)) == family


def test_a_named_network_is_known_under_any_name(shared_models: Path, tmp_path: Path) -> None:
    renamed = tmp_path / "model.onnx"
    shutil.copyfile(shared_models / models.MODELS["tcmonodepth"].file, renamed)
    assert network_family(renamed) == "tcmonodepth"
    renamed.write_bytes(renamed.read_bytes() + b"x")
    assert network_family(renamed) is None


def test_preprocessing_exactly(tmp_path: Path) -> None:
    spec = NetworkSpec(value_max=255.0, mean=(1.0, 2.0, 3.0), std=(2.0, 4.0, 8.0), size=(2, 3))
    image = np.arange(18, dtype=np.uint8).reshape(2, 3, 3)
    nchw = Network(save_network(tmp_path / "a.onnx", [1, 3, "h", "w"]), spec)(image)
    expected = (image[..., ::-1].astype(np.float64) - (1, 2, 3)) / (2, 4, 8)
    np.testing.assert_allclose(nchw, expected.transpose(2, 0, 1)[None], atol=1e-6)
    bgr = replace(spec, layout="NHWC", color="BGR", value_max=1.0)
    nhwc = Network(save_network(tmp_path / "b.onnx", [1, 2, 3, 3]), bgr)(image)
    np.testing.assert_allclose(nhwc[0], (image / 255.0 - (1, 2, 3)) / (2, 4, 8), atol=1e-6)


def test_half_precision_input(tmp_path: Path) -> None:
    path = save_network(
        tmp_path / "half.onnx", [1, 3, 2, 2], input_type=TensorProto.FLOAT16, output_type=TensorProto.FLOAT16
    )
    output = Network(path, NetworkSpec())(np.full((2, 2, 3), 255, np.uint8))
    assert output.dtype == np.float16
    np.testing.assert_array_equal(output, 1.0)


@pytest.mark.parametrize(
    ("name", "shape", "layout", "size"),
    [
        ("midas_small.onnx", [1, 3, 384, 384], "NCHW", (384, 384)),
        ("midas_small.onnx", ["n", 3, "h", "w"], "NCHW", None),
        ("fast_depth.onnx", [1, 224, 224, 3], "NHWC", (224, 224)),
        ("fast_depth.onnx", [1, 3, 192, 256], "NCHW", (192, 256)),
        ("fast_depth.onnx", ["a", "b", "c", "d"], "NHWC", (224, 224)),
        ("other.onnx", [1, 10, 20, 3], "NHWC", (10, 20)),
        ("other.onnx", [1, "c", "h", "w"], "NCHW", None),
    ],
)
def test_layout_and_size_are_read_off_the_input(
    tmp_path: Path, name: str, shape: list[int | str], layout: str, size: tuple[int, int] | None
) -> None:
    spec = Network(save_network(tmp_path / name, shape)).spec
    family = network_family(Path(name))
    assert (spec.layout, spec.size) == (layout, size)
    assert spec.mean == (NETWORK_SPECS[family].mean if family else (0.485, 0.456, 0.406))


def test_unknown_network_is_logged(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.WARNING):
        Network(save_network(tmp_path / "thing.onnx", [1, 3, 8, 8]))
    assert "thing.onnx is not a known network: it gets RGB with ImageNet normalisation" in caplog.text


@pytest.mark.parametrize(
    ("family", "size"),
    [("dpt", (384, 672)), ("depth_anything", (518, 924)), ("midas", (256, 448)), ("tcmonodepth", (192, 320))],
)
def test_free_input_size_keeps_the_aspect(tmp_path: Path, family: str, size: tuple[int, int]) -> None:
    network = Network(save_network(tmp_path / f"{family}.onnx", [1, 3, "h", "w"]))
    assert network.input_size(540, 960) == size
    assert network(np.zeros((54, 96, 3), np.uint8)).shape == (1, 3, *size)


def test_explicit_spec_wins_over_the_name(tmp_path: Path) -> None:
    path = save_network(tmp_path / "midas.onnx", [1, 3, "h", "w"])
    spec = NetworkSpec(mean=(0.5, 0.5, 0.5), size=(64, 96))
    assert Network(path, spec).spec == spec


@pytest.mark.parametrize(
    ("spec", "message"),
    [
        (NetworkSpec(layout="NHWC"), "says NHWC"),
        (NetworkSpec(size=(8, 9)), r"says height and width \(8, 9\), and the network takes \(8, 8\)"),
    ],
)
def test_spec_that_contradicts_the_network(tmp_path: Path, spec: NetworkSpec, message: str) -> None:
    with pytest.raises(ModelError, match=message):
        Network(save_network(tmp_path / "x.onnx", [1, 3, 8, 8]), spec)


@pytest.mark.parametrize(
    "options",
    [
        {"layout": "CHW"},
        {"color": "GBR"},
        {"interpolation": "nearest"},
        {"std": (1.0, 0.0, 1.0)},
        {"mean": (1.0, 0.0)},
        {"size": (0, 4)},
        {"size": (4,)},
        {"multiple_of": 0},
    ],
)
def test_spec_values_are_checked(options: dict[str, object]) -> None:
    with pytest.raises(ModelError):
        NetworkSpec(**options)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("shape", "input_type"),
    [
        ([1, 1, 8, 8], TensorProto.FLOAT),
        ([4, 3, 8, 8], TensorProto.FLOAT),
        ([3, 8, 8], TensorProto.FLOAT),
        ([1, 3, 8, 8], TensorProto.UINT8),
    ],
)
def test_networks_that_take_no_image(tmp_path: Path, shape: list[int], input_type: int) -> None:
    path = save_network(tmp_path / "x.onnx", shape, input_type=input_type, output_type=input_type)
    with pytest.raises(ModelError, match=r"x\.onnx is not an image network: expected one 4-D float input"):
        Network(path)


def test_networks_with_two_inputs(tmp_path: Path) -> None:
    other = helper.make_tensor_value_info("count", TensorProto.INT64, [])
    path = save_network(tmp_path / "x.onnx", [1, 3, 8, 8], extra_inputs=[other])
    with pytest.raises(ModelError, match=r"found image tensor\(float\).*, count tensor\(int64\)"):
        Network(path)


def test_missing_and_foreign_files(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(ModelError, match="there is no network file"):
        Network(tmp_path / "none.onnx")
    (tmp_path / "text.onnx").write_text("not a network")
    with pytest.raises(ModelError, match="is not an ONNX network that onnxruntime can load") as caught:
        Network(tmp_path / "text.onnx")
    assert "\n" not in str(caught.value)
    assert capfd.readouterr() == ("", "")


def test_failure_while_running(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    reshape = [
        helper.make_node("Constant", [], ["shape"], value_ints=[7]),
        helper.make_node("Reshape", ["image", "shape"], ["out"]),
    ]
    network = Network(save_network(tmp_path / "x.onnx", [1, 3, "h", "w"], reshape), NetworkSpec(size=(32, 64)))
    with pytest.raises(ModelError, match=r"x\.onnx fails on an input of 64x32"):
        network(np.zeros((8, 8, 3), np.uint8))
    assert capfd.readouterr() == ("", "")
