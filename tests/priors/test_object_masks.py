"""Folders of masks that tell objects apart."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from factorsfm import Frame, InputError, ObjectFolder
from factorsfm.priors.object_masks import open_objects


def frame(index: int) -> Frame:
    return Frame(index, np.zeros((90, 160, 3), np.uint8), f"{index:06d}")


def write(path: Path, values: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), values)


def square(left: int, value: int = 255, shape: tuple[int, ...] = (45, 80)) -> np.ndarray:
    mask = np.zeros(shape, np.uint8)
    mask[10:20, left : left + 10] = value
    return mask


def test_subfolders_are_objects(tmp_path: Path) -> None:
    write(tmp_path / "car" / "000000.png", square(5))
    write(tmp_path / "car" / "000001.png", square(15))
    write(tmp_path / "box" / "000001.png", square(40, 1))
    masks = ObjectFolder(tmp_path)
    assert list(masks(frame(0))) == ["car"]
    both = masks(frame(1))
    assert sorted(both) == ["box", "car"]
    assert (both["box"] == (square(40) > 0)).all()
    assert masks(frame(2)) == {}
    assert (masks.asked, masks.matched) == (3, 2)
    assert [masks.has(index) for index in range(3)] == [True, True, False]


def test_values_are_objects(tmp_path: Path) -> None:
    write(tmp_path / "0007.png", square(5, 1) + square(30, 2))
    write(tmp_path / "0008.png", square(5, 0))
    masks = ObjectFolder(tmp_path)
    found = masks(frame(7))
    assert sorted(found) == ["object-1", "object-2"]
    assert (found["object-2"] == (square(30) > 0)).all()
    assert masks(frame(8)) == {}
    assert masks.matched == 2  # a mask that shows no object is one


def test_what_are_no_masks_of_objects(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no folder"):
        open_objects(tmp_path / "absent")
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError, match="holds no masks of objects"):
        open_objects(tmp_path / "empty")
    write(tmp_path / "smooth" / "1.png", np.tile(np.arange(80, dtype=np.uint8), (45, 1)))
    with pytest.raises(InputError, match="has 79 values; expected one for each object, at most 50"):
        ObjectFolder(tmp_path / "smooth")(frame(1))
    coloured = np.dstack([square(5), square(5), 0 * square(5)])
    write(tmp_path / "coloured" / "1.png", coloured)
    with pytest.raises(InputError, match="is coloured"):
        ObjectFolder(tmp_path / "coloured")(frame(1))
    write(tmp_path / "wide" / "1.png", square(5, shape=(45, 120)))
    with pytest.raises(InputError, match="aspect ratios"):
        ObjectFolder(tmp_path / "wide")(frame(1))
    (tmp_path / "torn").mkdir()
    (tmp_path / "torn" / "1.png").write_bytes(b"none")
    with pytest.raises(InputError, match="cannot be read"):
        ObjectFolder(tmp_path / "torn")(frame(1))
    with pytest.raises(InputError, match="must be callable"):
        open_objects(3)  # type: ignore[arg-type]
    assert open_objects("none") is None
