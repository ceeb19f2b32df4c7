"""Depth maps, their look-up, and where they come from."""

import logging
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from onnx import helper

from factorsfm.frames.frame import Frame
from factorsfm.frames.reading import read_frames
from factorsfm.priors import DepthFolder, DepthKind, DepthMap, DepthModel, NetworkSpec, open_depth
from factorsfm.support.errors import InputError, ModelError
from tests.networks import save_network

SHOT = "studiosim/d02_livingroom_truck_actor"


def make_frame(name: str = "000000", index: int = 0, size: tuple[int, int] = (64, 48)) -> Frame:
    return Frame(index=index, image=np.zeros((size[1], size[0], 3), np.uint8), name=name, timestamp=None)


def inverse_map(values: object) -> DepthMap:
    return DepthMap(np.asarray(values, dtype=np.float32), DepthKind.INVERSE)


def rank_correlation(a: NDArray[np.floating], b: NDArray[np.floating]) -> float:
    return float(np.corrcoef(a.argsort().argsort(), b.argsort().argsort())[0, 1])


def read_shot(data: Path, index: int) -> tuple[Frame, NDArray[np.float64]]:
    """A frame of the development shot and its true depth in metres (NaN: none)."""
    (frame,) = read_frames(data / SHOT / "shot.mp4", slice(index, index + 1))
    depth = cv2.imread(str(data / SHOT / f"depth/{index:06d}.png"), cv2.IMREAD_UNCHANGED)
    return frame, np.where(depth > 0, depth * 0.0005, np.nan)


# Look-up


def test_bilinear_by_hand() -> None:
    grid = inverse_map([[1.0, 2.0, 3.0], [5.0, 7.0, 11.0]])
    points = [(0, 0), (2, 1), (0.5, 0), (0, 0.25), (1.25, 0.5)]
    values, _ = grid.inverse_depth(points, (3, 2))
    # last: upper row 2 + 0.25, lower row 7 + 0.25 * 4
    np.testing.assert_allclose(values, [1.0, 11.0, 1.5, 2.0, (2.25 + 8.0) / 2], rtol=1e-12)


def test_depth_is_inverted_after_interpolation() -> None:
    depth = DepthMap(np.array([[2.0, 4.0]], dtype=np.float32), DepthKind.METRIC)
    np.testing.assert_allclose(depth.inverse_depth([(0.5, 0)], (2, 1))[0], 1 / 3)
    np.testing.assert_allclose(depth.depth([(0.5, 0)], (2, 1))[0], 3.0)
    inverse = inverse_map([[2.0, 4.0]])
    np.testing.assert_allclose(inverse.inverse_depth([(0.5, 0)], (2, 1))[0], 3.0)
    np.testing.assert_allclose(inverse.depth([(0.5, 0)], (2, 1))[0], 1 / 3)


def test_maps_of_another_resolution_are_aligned_by_their_centres() -> None:
    # An image of 6 pixels over a map of 2: map pixel 0 is centred on image pixel 1, map pixel 1 on pixel 4.
    coarse = inverse_map([[10.0, 40.0]])
    points = [(x, 0) for x in (-0.5, 0, 1, 2, 2.5, 4, 5, 5.5)]
    values, _ = coarse.inverse_depth(points, (6, 3))
    np.testing.assert_allclose(values, [10, 10, 10, 20, 25, 40, 40, 40], rtol=1e-6)
    # An image of 2 pixels over a map of 6: the other way round.
    fine = inverse_map([[1.0, 2.0, 3.0, 4.0, 5.0, 6.0]])
    np.testing.assert_allclose(fine.inverse_depth([(0, 0), (1, 0)], (2, 1))[0], [2.0, 5.0], rtol=1e-6)


@given(
    map_size=st.tuples(st.integers(4, 40), st.integers(4, 40)),
    image_size=st.tuples(st.integers(4, 200), st.integers(4, 200)),
    at=st.tuples(st.floats(0.2, 0.8), st.floats(0.2, 0.8)),
)
def test_a_plane_is_reproduced_at_any_resolution(
    map_size: tuple[int, int], image_size: tuple[int, int], at: tuple[float, float]
) -> None:
    u = (np.arange(map_size[0]) + 0.5) / map_size[0]
    v = (np.arange(map_size[1]) + 0.5) / map_size[1]
    plane = inverse_map(1.0 + 2.0 * u + 3.0 * v[:, None])
    point = np.array(at) * image_size - 0.5
    values, _ = plane.inverse_depth([point], image_size)
    np.testing.assert_allclose(values, [1.0 + 2.0 * at[0] + 3.0 * at[1]], rtol=1e-6)


@pytest.mark.parametrize("kind", list(DepthKind))
@pytest.mark.parametrize("invalid", [0.0, -1.0, np.nan, np.inf, -np.inf])
def test_invalid_neighbours_count_only_with_weight(kind: DepthKind, invalid: float) -> None:
    values = np.full((4, 4), 2.0, dtype=np.float32)
    values[1, 2] = invalid
    depth_map = DepthMap(values, kind)
    points = [(2, 1), (1.5, 1), (2, 1.25), (1.01, 0.99), (1, 1), (3, 1), (2, 0), (2, 2), (0.5, 3), (1, 0.5)]
    for look_up, expected in ((depth_map.depth, 2.0), (depth_map.inverse_depth, 0.5)):
        found, reliability = look_up(points, (4, 4))
        assert np.isnan(found[:4]).all()
        np.testing.assert_array_equal(reliability[:4], 0.0)
        np.testing.assert_allclose(found[4:], 1 / expected if kind is DepthKind.INVERSE else expected)


def test_invalid_neighbours_at_another_resolution() -> None:
    # Every third pixel of the image lies exactly on a map pixel, where the invalid neighbour has no weight.
    values = np.ones((60, 107), dtype=np.float32)
    values[:, ::2] = np.nan
    on_valid = [(3 * i + 1, 3 * j + 1) for i in range(1, 106, 2) for j in range(60)]
    assert np.isfinite(inverse_map(values).inverse_depth(on_valid, (321, 180))[0]).all()


def test_points_outside_the_image_and_no_points() -> None:
    values, reliability = inverse_map(np.ones((4, 6))).inverse_depth(
        [(-0.6, 1), (5.6, 1), (2, -0.6), (2, 3.6), (np.nan, 1), (5.5, 3.5)], (6, 4)
    )
    assert np.isnan(values[:5]).all()
    np.testing.assert_array_equal(reliability, [0, 0, 0, 0, 0, 1])
    assert values[5] == 1.0
    empty, none = inverse_map(np.ones((4, 6))).inverse_depth(np.empty((0, 2)), (6, 4))
    assert empty.shape == none.shape == (0,)


def test_a_map_without_valid_values() -> None:
    values, reliability = inverse_map(np.zeros((4, 6))).inverse_depth([(1, 1), (2.5, 2)], (12, 8))
    assert np.isnan(values).all()
    np.testing.assert_array_equal(reliability, 0.0)


@pytest.mark.parametrize("shape", [(4,), (1, 2, 3), (0, 3)])
def test_maps_are_two_dimensional(shape: tuple[int, ...]) -> None:
    with pytest.raises(InputError, match="2-D"):
        DepthMap(np.ones(shape, dtype=np.float32), DepthKind.INVERSE)


# Reliability


def step_map(kind: DepthKind) -> DepthMap:
    inverse = np.tile(np.linspace(1.0, 1.2, 180)[:, None], (1, 320))
    inverse[:, 160:] += 1.0
    return DepthMap((inverse if kind is DepthKind.INVERSE else 1 / inverse).astype(np.float32), kind)


@pytest.mark.parametrize("kind", list(DepthKind))
def test_reliability_falls_to_zero_on_depth_edges_only(kind: DepthKind) -> None:
    columns = np.array([0, 100, 156, 159, 160, 163, 200, 319])
    _, reliability = step_map(kind).inverse_depth(np.column_stack([columns, np.full(8, 90)]), (320, 180))
    np.testing.assert_array_equal(reliability, [1, 1, 1, 0, 0, 1, 1, 1])


def test_reliability_does_not_depend_on_scale_and_shift() -> None:
    rng = np.random.default_rng(1)
    values = cv2.GaussianBlur(rng.random((90, 160)).astype(np.float32), (0, 0), 3) + 0.2
    values[:, 80:] += 0.15
    reliability = inverse_map(values).reliability
    assert 0.1 < reliability.mean() < 0.95
    np.testing.assert_allclose(inverse_map(7.0 * values + 0.4).reliability, reliability, atol=1e-5)


def test_reliability_of_slopes_flat_maps_and_holes() -> None:
    ramp = np.tile(np.linspace(0.1, 3.0, 180)[:, None], (1, 320))
    np.testing.assert_array_equal(inverse_map(ramp).reliability, 1.0)
    noise = 1.0 + 1e-4 * np.random.default_rng(0).random((180, 320))
    np.testing.assert_array_equal(inverse_map(noise).reliability, 1.0)
    ramp[50:60, 100:120] = 0.0
    holed = inverse_map(ramp).reliability
    np.testing.assert_array_equal(holed, np.where(ramp > 0, 1.0, 0.0))


def test_reliability_is_computed_once() -> None:
    depth_map = step_map(DepthKind.INVERSE)
    assert depth_map.reliability is depth_map.reliability


# Folders of maps


def write_map(path: Path, value: float, shape: tuple[int, int] = (24, 32)) -> None:
    values = np.full(shape, value, dtype=np.float32)
    if path.suffix == ".npy":
        np.save(path, values)
    elif path.suffix == ".npz":
        np.savez(path, depth=values, other=np.zeros(3))
    else:
        cv2.imwrite(str(path), values.astype(np.uint16))


def value_of(depth_map: DepthMap | None) -> float | None:
    return None if depth_map is None else float(depth_map.values[0, 0])


def test_folder_matches_by_name_before_number(tmp_path: Path) -> None:
    for name, value in (("a7", 1.0), ("b.jpg", 2.0), ("000012", 3.0), ("000003", 4.0)):
        write_map(tmp_path / f"{name}.npy", value)
    folder = DepthFolder(tmp_path)
    assert value_of(folder(make_frame("a7.jpg", index=12))) == 1.0
    assert value_of(folder(make_frame("b.jpg", index=12))) == 2.0
    assert value_of(folder(make_frame("b.png", index=12))) == 2.0
    assert value_of(folder(make_frame("shot2_0012.jpg", index=3))) == 3.0
    assert value_of(folder(make_frame("000003", index=3))) == 4.0
    assert value_of(folder(make_frame("nameless.jpg", index=3))) == 4.0
    assert folder.matched == 6
    assert folder(make_frame("0005.jpg", index=3)) is None  # its number is 5, whatever its index
    assert folder.matched == 6


def test_number_that_two_maps_share_is_not_used(tmp_path: Path) -> None:
    write_map(tmp_path / "left_0001.npy", 1.0)
    write_map(tmp_path / "right_0001.npy", 2.0)
    folder = DepthFolder(tmp_path)
    assert folder(make_frame("img_0001.jpg")) is None
    assert value_of(folder(make_frame("right_0001.jpg"))) == 2.0


def test_folder_formats_and_their_kinds(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    for suffix, kind in ((".png", DepthKind.DEPTH), (".npz", DepthKind.INVERSE), (".npy", DepthKind.INVERSE)):
        write_map(tmp_path / f"000000{suffix}", 1500)  # each format is preferred to those before
        with caplog.at_level(logging.WARNING):
            folder = DepthFolder(tmp_path)
        assert folder.kind is kind
        assert f"the {suffix} maps in {tmp_path} are taken as {kind}" in caplog.text
        assert value_of(folder(make_frame())) == 1500.0
    caplog.clear()
    assert DepthFolder(tmp_path, "metric").kind is DepthKind.METRIC
    assert not caplog.records


def test_metric_png_is_in_millimetres(tmp_path: Path) -> None:
    write_map(tmp_path / "000000.png", 1500)
    assert value_of(DepthFolder(tmp_path, DepthKind.METRIC)(make_frame())) == 1.5


def test_folder_maps_with_nothing_valid(tmp_path: Path) -> None:
    write_map(tmp_path / "000000.npy", -1.0)
    found = DepthFolder(tmp_path)(make_frame())
    assert found is not None
    assert np.isnan(found.values).all()


def test_folder_refuses_another_aspect(tmp_path: Path) -> None:
    write_map(tmp_path / "000000.npy", 1.0, shape=(30, 32))
    write_map(tmp_path / "000001.npy", 1.0, shape=(100, 132))  # 1 % off
    folder = DepthFolder(tmp_path)
    with pytest.raises(InputError, match=r"000000\.npy is 32x30 and its frame 64x48"):
        folder(make_frame())
    assert folder(make_frame(index=1, name="000001")) is not None


def test_unreadable_maps(tmp_path: Path) -> None:
    (tmp_path / "000000.npy").write_bytes(b"no array")
    np.save(tmp_path / "000001.npy", np.array([None, {}]), allow_pickle=True)
    np.save(tmp_path / "000002.npy", np.ones((24, 32, 3)))
    np.save(tmp_path / "000003.npy", np.ones((24, 32), dtype=complex))
    np.save(tmp_path / "000004.npy", np.ones((1, 24, 32, 1)))
    folder = DepthFolder(tmp_path)
    for index, message in (
        (0, "cannot be read"),
        (1, "cannot be read"),
        (2, r"\(24, 32, 3\)"),
        (3, "complex"),
    ):
        with pytest.raises(InputError, match=message):
            folder(make_frame(f"{index:06d}"))
    assert value_of(folder(make_frame("000004"))) == 1.0


@pytest.mark.parametrize("suffix", [".npz", ".png"])
def test_unreadable_archives_and_images(tmp_path: Path, suffix: str) -> None:
    (tmp_path / f"000000{suffix}").write_bytes(b"PK\x03\x04 cut off")
    with pytest.raises(InputError, match="cannot be read"):
        DepthFolder(tmp_path)(make_frame())


def test_png_of_eight_bits(tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "000000.png"), np.ones((24, 32), np.uint8))
    with pytest.raises(InputError, match="8 bits a pixel"):
        DepthFolder(tmp_path)(make_frame())


def test_folders_without_maps(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"holds no depth maps \(\.npy, \.npz, \.exr, \.png\)"):
        DepthFolder(tmp_path)
    with pytest.raises(InputError, match="there is no folder"):
        DepthFolder(tmp_path / "none")
    (tmp_path / "000000.exr").write_bytes(b"nothing that OpenCV reads")
    with pytest.raises(InputError, match=r"000000\.exr cannot be read by this build of OpenCV"):
        DepthFolder(tmp_path)


# Networks


def test_model_output_is_the_map(tmp_path: Path) -> None:
    red_channel = [helper.make_node("Gather", ["image", "zero"], ["out"], axis=1)]
    path = save_network(tmp_path / "red.onnx", [1, 3, 2, 2], red_channel)
    model = DepthModel(path, "depth", NetworkSpec(value_max=255.0))
    image = np.zeros((2, 2, 3), np.uint8)
    image[..., 2] = [[10, 20], [0, 40]]
    found = model(Frame(index=0, image=image, name="000000", timestamp=None))
    assert (model.kind, found.kind, model.name) == (DepthKind.DEPTH, DepthKind.DEPTH, "red.onnx")
    np.testing.assert_array_equal(found.values, np.array([[10, 20], [np.nan, 40]], dtype=np.float32))


def test_model_that_gives_no_map(tmp_path: Path) -> None:
    model = DepthModel(save_network(tmp_path / "midas.onnx", [1, 3, 8, 8]))
    with pytest.raises(ModelError, match=r"expected one float map, got float32 of shape \(1, 3, 8, 8\)"):
        model(make_frame())


@pytest.mark.parametrize(
    ("name", "kind", "logged"),
    [("midas", "inverse", False), ("fast_depth", "depth", False), ("unknown", "inverse", True)],
)
def test_default_kind_of_models(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, name: str, kind: str, logged: bool
) -> None:
    path = save_network(tmp_path / f"{name}.onnx", [1, 3, 8, 8])
    with caplog.at_level(logging.WARNING):
        assert DepthModel(path).kind == kind
    assert ("its output is taken as inverse (large = near)" in caplog.text) == logged


def test_tcmonodepth_ranks_depth(shared_data: Path, shared_models: Path) -> None:
    model = DepthModel(shared_models / "tcmonodepth_tcsmallnet_192x320.onnx")
    assert model.kind is DepthKind.INVERSE
    frame, truth = read_shot(shared_data, 20)
    v, u = np.nonzero(np.isfinite(truth))
    at = np.column_stack([3 * u + 1, 3 * v + 1])  # the truth holds every third pixel
    values, reliability = model(frame).inverse_depth(at, (960, 540))
    assert np.isfinite(values).all()
    assert 0.75 < rank_correlation(values, 1 / truth[v, u]) < 0.90  # measured 0.81
    # Its unreliable pixels are the true depth edges, as far as the network sees them.
    edge = DepthMap(truth, DepthKind.METRIC).reliability[v, u] == 0
    assert 0.30 < (reliability[edge] < 0.5).mean() < 0.60  # measured 0.44
    assert 0.005 < (reliability[~edge] < 0.5).mean() < 0.05  # measured 0.02


def test_named_model_through_the_models_folder(shared_models: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("FACTORSFM_MODELS", str(shared_models))
    prior = open_depth("tcmonodepth")
    assert isinstance(prior, DepthModel)
    assert prior.name == "tcmonodepth_tcsmallnet_192x320.onnx"


def test_fastdepth_gives_plausible_metres(shared_data: Path, shared_models: Path) -> None:
    path = shared_models / "fast_depth_224_fp32.onnx"
    assert DepthModel(path).kind is DepthKind.DEPTH
    frame, truth = read_shot(shared_data, 20)
    found = DepthModel(path, DepthKind.METRIC)(frame)
    assert found.kind is DepthKind.METRIC
    assert found.values.shape == (224, 224)
    v, u = np.nonzero(np.isfinite(truth))
    metres, _ = found.depth(np.column_stack([3 * u + 1, 3 * v + 1]), (960, 540))
    assert 1.0 < metres.min() < np.median(metres) < metres.max() < 10.0
    assert 0.3 < np.median(metres) / np.nanmedian(truth) < 1.5  # measured 0.52: its scale is that of its rooms
    assert 0.7 < rank_correlation(metres, truth[v, u]) < 0.9  # measured 0.81


# open_depth


def test_open_depth(tmp_path: Path) -> None:
    assert open_depth(None) is None
    assert open_depth("none") is None
    write_map(tmp_path / "000000.npy", 1.0)
    folder = open_depth(tmp_path, "depth")
    assert isinstance(folder, DepthFolder)
    assert folder.kind is DepthKind.DEPTH
    assert open_depth(folder) is folder
    assert open_depth(folder, DepthKind.DEPTH) is folder
    model = open_depth(str(save_network(tmp_path / "dpt.onnx", [1, 3, 8, 8])))
    assert isinstance(model, DepthModel)


def test_open_depth_refuses_anything_else(tmp_path: Path) -> None:
    expected = "expected an existing folder of depth maps, an .onnx file, a named network .tcmonodepth. or none"
    for spec in ("nothing", tmp_path / "missing", __file__):
        with pytest.raises(InputError, match=expected):
            open_depth(spec)
    with pytest.raises(InputError, match="must have a kind and a name and be callable, not 3"):
        open_depth(3)  # type: ignore[arg-type]
    with pytest.raises(ModelError, match=r"there is no network .*missing\.onnx"):
        open_depth(tmp_path / "missing.onnx")
    write_map(tmp_path / "000000.npy", 1.0)
    with pytest.raises(InputError, match="no depth kind 'far': expected inverse, depth, metric"):
        open_depth(tmp_path, "far")
    with pytest.raises(InputError, match="is of kind inverse, not depth"):
        open_depth(DepthFolder(tmp_path), "depth")
