"""Images named by the time at which they were recorded."""

import itertools
import json
import threading
from pathlib import Path

import cv2
import numpy as np
import pytest

from factorsfm.cli.main import main
from factorsfm.frames.frame import Frame
from factorsfm.frames.live_sources import open_source
from factorsfm.frames.name_times import times_in
from factorsfm.frames.reading import read_frames
from factorsfm.frames.sequences import sequence_numbers
from factorsfm.frames.unordered import looks_unordered
from factorsfm.priors.depth import DepthFolder
from factorsfm.support.errors import InputError
from tests.frames.test_cuts import HEIGHT, WIDTH, shot

SECONDS = [1305031102.97, 1305031103.003333, 1305031103.04, 1305031103.0700001]


@pytest.mark.parametrize(
    ("names", "times"),
    [
        ([f"{time:.6f}.png" for time in SECONDS[:3]], SECONDS[:3]),
        ([f"{time}.png" for time in SECONDS], SECONDS),  # of any number of decimals
        (["rgb-1305031102.175304.PNG", "rgb-1305031102.211214.png"], [1305031102.175304, 1305031102.211214]),
        (["1403636579763555584.png", "1403636579813555456.png"], [1403636579.763555584, 1403636579.813555456]),
        (["1403636579763.jpg"], [1403636579.763]),
        (["1305031102-966667000.png", "1305031103-000000000.png"], [1305031102.966667, 1305031103.0]),
        (["0.000000.png", "0.033333.png", "0.066667.png"], [0.0, 0.033333, 0.066667]),
        (["0.0.png", "0.04.png", "0.08.png", "0.12.png", "0.2.png"], [0.0, 0.04, 0.08, 0.12, 0.2]),
        (["t0.967.png", "t1.000.png", "t1.033.png"], [0.967, 1.0, 1.033]),
    ],
)
def test_names_that_are_times(names, times):
    np.testing.assert_allclose(times_in(names), times, rtol=0.0, atol=1e-6)
    assert sequence_numbers(names) is None


@pytest.mark.parametrize(
    "names",
    [
        [f"plate.{number}.png" for number in range(1001, 1009)],
        [f"{number:010d}.png" for number in range(4)],
        [f"1.{number:06d}.png" for number in range(1, 5)],  # a scene and a frame
        [f"{scene}.{number:03d}.png" for scene in (1, 2) for number in range(1, 9)],
        [f"v1.{number}.png" for number in range(8, 12)],
        ["shot1.000001.png"],
        ["1305031102_17.png", "1305031102_18.png"],
        ["20240131_120000.jpg", "20240131_120001.jpg"],
        ["IMG_1305031102175.jpg", "DSC_1305031102205.jpg"],
        ["1305031102.175304.png", "mask.png"],
        [],
    ],
)
def test_names_that_are_no_times(names):
    assert times_in(names) is None


def run(*arguments: object) -> int:
    return main([str(argument) for argument in arguments])


def write(folder: Path, images: list[np.ndarray], times: list[float] | np.ndarray) -> list[str]:
    folder.mkdir()
    names = [f"{time:.6f}.png" for time in times]
    for name, image in zip(names, images, strict=True):
        cv2.imwrite(str(folder / name), image)
    return names


@pytest.mark.parametrize("begin", [1305031102.8, 1305031102.1])  # over the end of a second, and within one
def test_a_folder_of_them_is_a_shot_with_these_times(tmp_path, begin):
    times = begin + np.array([0, 33, 67, 100, 167, 200, 233, 267, 300, 333]) / 1000
    names = write(tmp_path / "rgb", shot(0, 10), times)
    assert not looks_unordered(tmp_path / "rgb")
    frames = list(read_frames(tmp_path / "rgb", slice(1, 9, 2)))
    assert [frame.index for frame in frames] == [1, 3, 5, 7]
    assert [frame.name for frame in frames] == names[1:9:2]
    np.testing.assert_allclose([frame.timestamp for frame in frames], times[1:9:2], atol=1e-5)
    (tmp_path / "rgb" / "end").touch()
    for options in ({}, {"watch": True, "end_file": "end"}):
        live = list(open_source(tmp_path / "rgb", **options))
        assert [frame.index for frame in live] == list(range(10))
        np.testing.assert_allclose([frame.timestamp for frame in live], times, atol=1e-5)


@pytest.mark.parametrize("name", ["frame_{0:04d}_{1:.6f}.png", "f{0}-t{2}.png"])
def test_frames_with_a_number_and_a_time_are_a_shot(tmp_path, name):
    for k, image in enumerate(shot(0, 12)):
        cv2.imwrite(str(tmp_path / name.format(k, 1305031102.8 + k / 30, 33 * k)), image)
    assert not looks_unordered(tmp_path)
    images = [frame.image for frame in read_frames(tmp_path)]
    np.testing.assert_array_equal(images, shot(0, 12))


def test_their_order_is_that_of_the_times(tmp_path):
    for k, text in enumerate(["1305031102.9", "1305031102.9333", "1305031102.966667", "1305031103.0", "1305031103.03"]):
        cv2.imwrite(str(tmp_path / f"{text}.png"), np.full((32, 32), k, np.uint8))
    assert [int(frame.image[0, 0, 0]) for frame in read_frames(tmp_path)] == [0, 1, 2, 3, 4]


def test_a_result_has_them_and_film_tools_are_told_that_there_is_no_plate(tmp_path, caplog):
    times = 1305031102.8 + np.arange(10) / 25
    write(tmp_path / "rgb", shot(0, 10), times)
    camera = {"width": WIDTH, "height": HEIGHT, "fx": 480.0, "fy": 480.0, "cx": 239.5, "cy": 134.5}
    (tmp_path / "camera.json").write_text(json.dumps(camera))
    known = ["--camera", tmp_path / "camera.json", "--depth", "none", "--output", tmp_path / "out"]
    assert run("reconstruct", tmp_path / "rgb", *known) == 0
    statuses = json.loads((tmp_path / "out" / "summary.json").read_text())["statuses"]
    assert [status["index"] for status in statuses] == list(range(10))
    np.testing.assert_allclose([status["timestamp"] for status in statuses], times, atol=1e-5)
    assert run("export", tmp_path / "out", "--format", "tum", "--output", tmp_path / "path.tum") == 0
    np.testing.assert_allclose(np.loadtxt(tmp_path / "path.tum")[:, 0], times, atol=1e-5)
    assert run("export", tmp_path / "out", "--format", "nuke", "--output", tmp_path / "scene.nk") == 0
    assert "not numbered alike, as film tools expect it of a sequence" in caplog.text


def test_depth_maps_with_times_of_their_own_belong_to_the_nearest_frames(tmp_path):
    maps = [np.full((8, 8), 1000 * k, np.uint16) for k in range(1, 6)]
    write(tmp_path / "depth", maps, 1305031102.98 + np.arange(5) / 30)
    depth = DepthFolder(tmp_path / "depth")
    image = np.zeros((8, 8, 3), np.uint8)
    times = [1305031102.5, 1305031102.99, 1305031103.05]
    found = [depth(Frame(k, image, f"{time:.6f}.png", time)) for k, time in enumerate(times)]
    assert found[0] is None
    assert [float(each.values[0, 0]) for each in found[1:]] == [1000.0, 3000.0]
    assert depth(Frame(980000, image, "980000")) is None  # the decimals of a time are no number of a frame


def test_images_in_folders_inside_are_named(tmp_path):
    (tmp_path / "mav0" / "cam0" / "data").mkdir(parents=True)
    (tmp_path / "mav0" / "cam0" / "data.csv").touch()
    write(tmp_path / "mav0" / "cam0" / "data" / "more", shot(0, 2), [1305031102.1, 1305031102.2])
    with pytest.raises(InputError, match=r"holds no images \(.*webp\)$"):
        list(read_frames(tmp_path))
    with pytest.raises(InputError, match=r"\); folders inside do: cam0/data/more$"):
        list(read_frames(tmp_path / "mav0"))


# --- several sequences in a folder that is being filled ----------------------------------------------------------


def fill(folder: Path, *names: str) -> None:
    for name in names:
        cv2.imwrite(str(folder / name), np.full((40, 64), 90, np.uint8))


def plates(name: str, *numbers: int) -> list[str]:
    return [f"{name}.{number}.png" for number in numbers]


def test_a_watched_folder_with_two_sequences_is_refused_with_their_names(tmp_path):
    fill(tmp_path, *plates("left", 1001, 1002), *plates("right", 1001, 1002))
    with pytest.raises(InputError, match=r"holds 2 sequences \(left.####.png, right.####.png\)"):
        list(open_source(tmp_path, watch=True, end_file="end"))


def test_two_sequences_that_arrive_side_by_side_break_off(tmp_path):
    fill(tmp_path, *plates("left", 1001), *plates("right", 1001))
    source = open_source(tmp_path, watch=True, end_file="end", stall_seconds=5.0)
    assert [next(source).name for _ in range(2)] == ["left.1001.png", "right.1001.png"]
    fill(tmp_path, *plates("left", 1002), *plates("right", 1002))
    assert list(source) == []
    assert "broken off after 2 frames" in source.ended
    assert "holds 2 sequences (left.####.png, right.####.png); a folder with one of them" in source.ended


def test_what_does_not_go_on_with_a_long_sequence_is_left_out(tmp_path, caplog):
    fill(tmp_path, *plates("left", *range(1001, 1011)))
    source = open_source(tmp_path, watch=True, end_file="end", stall_seconds=5.0)
    taken = [frame.name for frame in itertools.islice(source, 10)]
    fill(tmp_path, *plates("right", 1001, 1002), "zebra.png")
    threading.Timer(0.6, lambda: (fill(tmp_path, *plates("left", 1011)), (tmp_path / "end").touch())).start()
    assert [*taken, *(frame.name for frame in source)] == plates("left", *range(1001, 1012))
    left_out = [record.message for record in caplog.records]
    assert len(left_out) == 3
    assert all("is left out: it does not go on with the sequence of left.10" in message for message in left_out)


def test_negative_numbers_in_a_watched_folder_are_refused(tmp_path):
    fill(tmp_path, "plate.-0002.png", "plate.-0001.png")
    with pytest.raises(InputError, match=r"negative numbers \(plate.-0001.png\)"):
        list(open_source(tmp_path, watch=True, end_file="end"))
