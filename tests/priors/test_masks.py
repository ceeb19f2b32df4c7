"""Masks: from folders, in COLMAP's style, and from a segmentation network."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from onnx import TensorProto, helper

from factorsfm.frames.frame import Frame
from factorsfm.frames.reading import read_frames
from factorsfm.priors import MaskFolder, MaskModel, NetworkSpec, open_masks
from factorsfm.priors.masks import MOVABLE_LABELS, PEOPLE_LABELS
from factorsfm.support.errors import InputError, ModelError
from tests.networks import save_network

SHOT = "studiosim/d02_livingroom_truck_actor"


def make_frame(name: str = "000000", index: int = 0, size: tuple[int, int] = (64, 48)) -> Frame:
    return Frame(index=index, image=np.zeros((size[1], size[0], 3), np.uint8), name=name, timestamp=None)


def make_mask(shape: tuple[int, int] = (48, 64), value: int = 255) -> NDArray[np.uint8]:
    """Marked in the rows 8..15 and columns 16..31, of 48 x 64, at any resolution."""
    mask = np.zeros(shape, np.uint8)
    height, width = shape
    mask[height // 6 : height // 3, width // 4 : width // 2] = value
    return mask


def expected_mask(grown: int = 0) -> NDArray[np.bool_]:
    return cv2.dilate(make_mask(), cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * grown + 1, 2 * grown + 1))).astype(
        bool
    )


@pytest.mark.parametrize("shape", [(48, 64), (24, 32), (96, 128), (12, 16)])
def test_mask_of_any_size_fits_the_frame(tmp_path: Path, shape: tuple[int, int]) -> None:
    cv2.imwrite(str(tmp_path / "000000.png"), make_mask(shape))
    found = MaskFolder(tmp_path, margin=0.0)(make_frame())
    assert found is not None
    assert found.dtype == np.bool_
    np.testing.assert_array_equal(found, expected_mask())


def test_margin_is_a_share_of_the_width(tmp_path: Path) -> None:
    mask = np.zeros((540, 960), np.uint8)
    mask[200:300, 400:500] = 1  # any value but zero counts
    cv2.imwrite(str(tmp_path / "000000.png"), mask)
    frame = make_frame(size=(960, 540))
    grown = MaskFolder(tmp_path)(frame)
    assert grown is not None
    rows, columns = np.nonzero(grown)
    assert (rows.min(), rows.max(), columns.min(), columns.max()) == (194, 305, 394, 505)  # 0.6 % of 960
    assert not grown[194, 394]  # round at the corners
    exact = MaskFolder(tmp_path, margin=0.0)(frame)
    np.testing.assert_array_equal(exact, mask > 0)


@pytest.mark.parametrize("margin", [-0.1, 0.5, float("nan")])
def test_margin_is_checked(tmp_path: Path, margin: float) -> None:
    cv2.imwrite(str(tmp_path / "000000.png"), make_mask())
    with pytest.raises(InputError, match=r"share of the image width from 0 to 0\.5"):
        MaskFolder(tmp_path, margin)


def test_colour_alpha_and_deep_masks(tmp_path: Path) -> None:
    mask = make_mask(value=1)
    blue = np.dstack([mask, 0 * mask, 0 * mask])
    images = (blue, np.dstack([blue, np.full_like(mask, 255)]), mask.astype(np.uint16) * 256)
    for index, image in enumerate(images):
        cv2.imwrite(str(tmp_path / f"{index:06d}.png"), image)
        found = MaskFolder(tmp_path, margin=0.0)(make_frame(f"{index:06d}"))
        np.testing.assert_array_equal(found, expected_mask())


def test_colmap_style_masks_are_inverted(tmp_path: Path) -> None:
    keep = 255 - make_mask()
    cv2.imwrite(str(tmp_path / "a1.jpg.png"), keep)
    cv2.imwrite(str(tmp_path / "a2.png.png"), keep)
    cv2.imwrite(str(tmp_path / "a3.png"), make_mask())
    folder = MaskFolder(tmp_path, margin=0.0)
    for name in ("a1.jpg", "a2.png", "a3.png", "other_0002.jpg"):
        np.testing.assert_array_equal(folder(make_frame(name)), expected_mask(), err_msg=name)
    assert folder.matched == 4


def test_frames_may_lack_a_mask(tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "mask_0007.png"), make_mask())
    folder = MaskFolder(tmp_path)
    assert folder(make_frame("000006", index=6)) is None
    assert folder(make_frame("000007", index=7)) is not None
    assert folder.matched == 1


def test_masks_that_cannot_be_used(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="holds no masks"):
        MaskFolder(tmp_path)
    cv2.imwrite(str(tmp_path / "000000.png"), make_mask((48, 48)))
    (tmp_path / "000001.png").write_bytes(b"no image")
    folder = MaskFolder(tmp_path)
    with pytest.raises(InputError, match=r"000000\.png is 48x48 and its frame 64x48"):
        folder(make_frame("000000"))
    with pytest.raises(InputError, match=r"the mask .*000001\.png cannot be read"):
        folder(make_frame("000001"))


def test_true_masks_of_a_shot(shared_data: Path) -> None:
    (frame,) = read_frames(shared_data / SHOT / "shot.mp4", slice(40, 41))
    found = MaskFolder(shared_data / SHOT / "masks", margin=0.0)(frame)
    small = cv2.imread(str(shared_data / SHOT / "masks/000040.png"), cv2.IMREAD_UNCHANGED) > 0
    np.testing.assert_array_equal(found, np.kron(small, np.ones((3, 3), bool)))


# Networks


def label_image() -> Frame:
    image = np.zeros((48, 64, 3), np.uint8)
    image[8:16, 16:32, 2] = 15  # red carries the label: a person,
    image[30:40, :, 2] = 9  # and a chair
    return Frame(index=0, image=image, name="000000", timestamp=None)


def test_label_map(tmp_path: Path) -> None:
    nodes = [
        helper.make_node("Gather", ["image", "zero"], ["red"], axis=1),
        helper.make_node("Cast", ["red"], ["out"], to=TensorProto.INT64),
    ]
    path = save_network(tmp_path / "labels.onnx", [1, 3, 48, 64], nodes, output_type=TensorProto.INT64)
    spec = NetworkSpec(value_max=255.0)
    np.testing.assert_array_equal(MaskModel(path, spec, margin=0.0)(label_image()), expected_mask())
    np.testing.assert_array_equal(MaskModel(path, spec, margin=0.05)(label_image()), expected_mask(grown=3))
    chairs = MaskModel(path, spec, labels={9}, margin=0.0)(label_image())
    assert chairs[30:40].all()
    assert chairs.sum() == 640


@pytest.mark.parametrize(("layout", "shape"), [("NCHW", [1, 3, 48, 64]), ("NHWC", [1, 48, 64, 3])])
def test_score_maps(tmp_path: Path, layout: str, shape: list[int]) -> None:
    image = np.zeros((48, 64, 3), np.uint8)
    image[..., 1] = 100
    image[8:16, 16:32, 0] = 200  # blue wins: the last of the three labels in RGB order
    path = save_network(tmp_path / "scores.onnx", shape)
    frame = Frame(index=0, image=image, name="000000", timestamp=None)
    model = MaskModel(path, NetworkSpec(layout=layout), labels={2}, margin=0.0)  # type: ignore[arg-type]
    np.testing.assert_array_equal(model(frame), expected_mask())


def test_networks_that_label_nothing(tmp_path: Path) -> None:
    depth = [helper.make_node("Gather", ["image", "zero"], ["out"], axis=1)]
    path = save_network(tmp_path / "depth.onnx", [1, 3, 8, 8], depth)
    with pytest.raises(ModelError, match=r"not a segmentation network: .* got float32 of shape \(1, 8, 8\)"):
        MaskModel(path)(make_frame())
    with pytest.raises(InputError, match="at least one label"):
        MaskModel(path, labels=())


def test_deeplab_finds_the_actor(shared_data: Path, shared_models: Path) -> None:
    model = MaskModel(shared_models / "deeplabv3_mnv2_dm05_pascal.onnx", margin=0.0)
    (frame,) = read_frames(shared_data / SHOT / "shot.mp4", slice(60, 61))
    truth = MaskFolder(shared_data / SHOT / "masks", margin=0.0)(frame)
    found = model(frame)
    assert truth is not None
    assert found.shape == (540, 960)
    overlap = (found & truth).sum() / (found | truth).sum()
    recall = (found & truth).sum() / truth.sum()
    assert 0.60 < overlap < 0.78  # measured 0.69; two random masks of these sizes: 0.03
    assert 0.70 < recall < 0.92  # measured 0.81; chance: 0.06, the share of the image that is marked
    assert 0.04 < found.mean() < 0.09


# open_masks


def test_open_masks(tmp_path: Path) -> None:
    assert open_masks(None) is None
    assert open_masks("none") is None
    cv2.imwrite(str(tmp_path / "000000.png"), make_mask())
    folder = open_masks(str(tmp_path))
    assert isinstance(folder, MaskFolder)
    assert open_masks(folder) is folder
    assert isinstance(open_masks(save_network(tmp_path / "deeplab.onnx", [1, 8, 8, 3])), MaskModel)


def test_people_by_name(shared_models: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("FACTORSFM_MODELS", str(shared_models))
    people, movable = open_masks("people"), open_masks("movable")
    assert isinstance(people, MaskModel)
    assert isinstance(movable, MaskModel)
    assert people.name == movable.name == "deeplabv3_mnv2_dm05_pascal.onnx"
    assert people.soft
    assert not getattr(MaskFolder, "soft", False)
    (tmp_path / "deeplabv3_mnv2_dm05_pascal.onnx").write_bytes(b"another network")
    monkeypatch.setenv("FACTORSFM_MODELS", str(tmp_path))
    with pytest.raises(ModelError, match=r"pascal\.onnx is not the network deeplab: .* expected e80797f7dd32"):
        open_masks("people")


@pytest.mark.parametrize(("labels", "marked"), [(PEOPLE_LABELS, {15}), (MOVABLE_LABELS, {7, 15})])
def test_people_are_no_vehicles(tmp_path: Path, labels: frozenset[int], marked: set[int]) -> None:
    nodes = [
        helper.make_node("Gather", ["image", "zero"], ["red"], axis=1),
        helper.make_node("Cast", ["red"], ["out"], to=TensorProto.INT64),
    ]
    path = save_network(tmp_path / "labels.onnx", [1, 3, 48, 64], nodes, output_type=TensorProto.INT64)
    frame = label_image()
    frame.image[40:, :, 2] = 7  # a car
    found = MaskModel(path, NetworkSpec(value_max=255.0), labels, margin=0.0)(frame)
    assert set(frame.image[..., 2][found].tolist()) == marked


def test_open_masks_refuses_anything_else(tmp_path: Path) -> None:
    with pytest.raises(
        InputError, match=r"expected an existing folder of masks, an \.onnx file, people, movable or none"
    ):
        open_masks(tmp_path / "missing")
    with pytest.raises(InputError, match="must be callable with a frame, not 3"):
        open_masks(3)  # type: ignore[arg-type]
