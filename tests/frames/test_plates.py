"""Plates: EXR, DPX, and images of 16 bits, written here by other tools than those that read them."""

import logging
import struct
from pathlib import Path

import cv2
import numpy as np
import OpenEXR
import pytest

from factorsfm.frames.folders import read_image, read_pixels, stated_pixel_aspect
from factorsfm.frames.numbering import missing_numbers, numbered_images, sequence_of
from factorsfm.frames.ranges import parse_range
from factorsfm.frames.reading import read_frames
from factorsfm.frames.sequences import mixture, sequence_numbers
from factorsfm.frames.tone import eight_bits, tone_curve
from factorsfm.frames.unordered import looks_unordered
from factorsfm.support.errors import InputError

WIDTH, HEIGHT = 96, 64


def colors(dtype: type, high: float) -> np.ndarray:
    """(h, w, 3) RGB, each channel another pattern."""
    return (np.random.default_rng(3).random((HEIGHT, WIDTH, 3)) * high).astype(dtype)


def write_exr(path: Path, channels: dict[str, np.ndarray], **header: object) -> None:
    content = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage, **header}
    with OpenEXR.File(content, channels) as file:
        file.write(str(path))


def window(left: int, top: int, width: int, height: int) -> tuple[np.ndarray, np.ndarray]:
    return np.array([left, top], np.int32), np.array([left + width - 1, top + height - 1], np.int32)


@pytest.mark.parametrize("dtype", [np.float16, np.float32])
def test_exr_keeps_its_numbers(tmp_path, dtype):
    rgb = colors(dtype, 20)
    write_exr(tmp_path / "a.exr", {"RGB": rgb})
    found = read_pixels(tmp_path / "a.exr")
    assert found.dtype == dtype
    np.testing.assert_array_equal(found, rgb[..., ::-1])


@pytest.mark.parametrize("kind", ["alpha and more", "layer", "grey"])
def test_exr_of_several_channels_gives_its_colours(tmp_path, kind):
    rgb, depth = colors(np.float16, 2), np.full((HEIGHT, WIDTH), 7, np.float32)
    expected = rgb[..., ::-1]
    if kind == "alpha and more":
        alpha = np.dstack([rgb, np.ones((HEIGHT, WIDTH), np.float16)])
        channels = {"RGBA": alpha, "depth.Z": depth, "diffuse.R": rgb[..., 0] * 0, "id": depth.astype(np.uint32)}
    elif kind == "layer":
        channels = {f"beauty.{name}": np.ascontiguousarray(rgb[..., k]) for k, name in enumerate("RGB")} | {"Z": depth}
    else:
        channels = {"Y": np.ascontiguousarray(rgb[..., 0])}
        expected = np.repeat(rgb[..., :1], 3, axis=2)
    write_exr(tmp_path / "a.exr", channels)
    np.testing.assert_array_equal(read_pixels(tmp_path / "a.exr"), expected)


def test_exr_without_colours_says_what_it_holds(tmp_path):
    write_exr(tmp_path / "a.exr", {"Z": np.ones((HEIGHT, WIDTH), np.float32)})
    with pytest.raises(InputError, match=r"a\.exr has no colours R, G, B or Y of half or float; it holds Z"):
        read_image(tmp_path / "a.exr")


@pytest.mark.parametrize(("left", "top"), [(10, 5), (-30, -20), (10, -20), (500, 0)])
def test_exr_shows_its_display_window(tmp_path, left, top):
    """The data window lies inside, beyond the corner, across it, and wholly outside."""
    rgb = colors(np.float16, 2)
    display = window(3, 2, 80, 50)
    write_exr(tmp_path / "a.exr", {"RGB": rgb}, dataWindow=window(left, top, WIDTH, HEIGHT), displayWindow=display)
    world = np.zeros((700, 700, 3), np.float16)
    world[100 + top : 100 + top + HEIGHT, 100 + left : 100 + left + WIDTH] = rgb
    np.testing.assert_array_equal(read_pixels(tmp_path / "a.exr"), world[102:152, 103:183, ::-1])


def test_damaged_plates_are_named(tmp_path):
    write_exr(tmp_path / "a.exr", {"RGB": colors(np.float16, 2)})
    data = (tmp_path / "a.exr").read_bytes()
    for name, content in {"a.exr": data[:200], "b.exr": b"", "c.exr": data[:-9], "d.dpx": b"SDPX"}.items():
        (tmp_path / name).write_bytes(content)
        with pytest.raises(InputError, match=rf"image .*{name} cannot be decoded as {name[-3:].upper()}"):
            read_image(tmp_path / name)
    with pytest.raises(InputError, match=r"e\.exr cannot be read: No such file"):
        read_image(tmp_path / "e.exr")


def test_damaged_plates_say_nothing_on_standard_output_and_error(tmp_path, capfd):
    write_exr(tmp_path / "a.exr", {"RGB": colors(np.float16, 1)})
    data = (tmp_path / "a.exr").read_bytes()
    for share in (0.1, 0.5, 0.99):
        (tmp_path / "a.exr").write_bytes(data[: int(share * len(data))])
        with pytest.raises(InputError, match=r"a\.exr cannot be decoded"):
            read_image(tmp_path / "a.exr")
    middle = len(data) // 2
    (tmp_path / "a.exr").write_bytes(data[:middle] + bytes(middle // 4) + data[middle + middle // 4 :])
    with pytest.raises(InputError, match=r"a\.exr cannot be decoded"):
        read_image(tmp_path / "a.exr")
    assert capfd.readouterr() == ("", "")


def test_pixel_aspect_of_plates(tmp_path, caplog):
    write_exr(tmp_path / "a.1.exr", {"RGB": colors(np.float16, 1)}, pixelAspectRatio=2.0)
    assert next(read_frames(tmp_path)).pixel_aspect == 2.0
    assert next(read_frames(tmp_path, pixel_aspect=1.5)).pixel_aspect == 1.5
    for order, magic in ((">", b"SDPX"), ("<", b"XPDS")):
        for aspect, expected in (((4, 3), 4 / 3), ((0, 1), 1.0), ((2**32 - 1, 2**32 - 1), 1.0)):
            (tmp_path / "a.dpx").write_bytes(magic + bytes(1624) + struct.pack(f"{order}2I", *aspect))
            assert stated_pixel_aspect(tmp_path / "a.dpx") == pytest.approx(expected)
    assert caplog.text == ""
    (tmp_path / "a.dpx").write_bytes(b"SDPX" + bytes(1624) + struct.pack(">2I", 1, 100))
    write_exr(tmp_path / "a.1.exr", {"RGB": colors(np.float16, 1)}, pixelAspectRatio=100.0)
    assert stated_pixel_aspect(tmp_path / "a.dpx") == stated_pixel_aspect(tmp_path / "a.1.exr") == 1.0
    assert caplog.text.count("which is ignored; 0.25 to 4 is expected") == 2
    (tmp_path / "a.dpx").write_bytes(b"SDPX")
    assert stated_pixel_aspect(tmp_path / "a.dpx") == 1.0


@pytest.mark.parametrize("endian", ["little", "big"])
@pytest.mark.parametrize("bits", [10, 12, 16])
def test_dpx_keeps_its_bits(tmp_path, bits, endian):
    oiio = pytest.importorskip("OpenImageIO")
    rgb = colors(np.uint16, 65535) >> (16 - bits) << (16 - bits)
    spec = oiio.ImageSpec(WIDTH, HEIGHT, 3, oiio.UINT16)
    spec.attribute("oiio:BitsPerSample", bits)
    spec.attribute("oiio:Endian", endian)
    path = tmp_path / "shot %04d.dpx"
    out = oiio.ImageOutput.create(str(path))
    assert out.open(str(path), spec)
    out.write_image(rgb)
    out.close()
    found = read_pixels(path)
    assert found.dtype == np.uint16
    assert np.abs(found[..., ::-1].astype(int) - rgb).max() < 1 << (16 - bits)  # one step of the file
    assert np.abs(read_image(path)[..., ::-1].astype(int) - rgb / 257).max() < 1.01 + 0.25 * (bits == 10)


def test_linear_dpx_goes_through_the_tone_curve(tmp_path):
    oiio = pytest.importorskip("OpenImageIO")
    spec = oiio.ImageSpec(WIDTH, HEIGHT, 3, oiio.UINT16)
    spec.attribute("oiio:BitsPerSample", 16)
    spec.attribute("dpx:Transfer", "Linear")
    out = oiio.ImageOutput.create(str(tmp_path / "a.dpx"))
    assert out.open(str(tmp_path / "a.dpx"), spec)
    out.write_image(np.full((HEIGHT, WIDTH, 3), round(0.18 * 65535), np.uint16))
    out.close()
    assert np.unique(read_image(tmp_path / "a.dpx")).tolist() == [95]


@pytest.mark.parametrize(
    ("name", "options"),
    [
        *[("a.dpx", {"oiio:BitsPerSample": bits}) for bits in (10, 16)],
        *[("a.exr", {"compression": how}) for how in ("none", "piz", "b44")],
        *[("a.tif", {"compression": how}) for how in ("none", "packbits")],
        ("a.bmp", {}),
    ],
)
def test_what_ends_early_is_refused_also_where_nothing_is_compressed(tmp_path, name, options, capfd):
    oiio = pytest.importorskip("OpenImageIO")
    path = tmp_path / name
    spec = oiio.ImageSpec(WIDTH, HEIGHT, 3, {".dpx": "uint16", ".exr": "half"}.get(path.suffix, "uint8"))
    for key, value in options.items():
        spec.attribute(key, value)
    out = oiio.ImageOutput.create(str(path))
    assert out.open(str(path), spec)
    out.write_image(colors(np.uint16, 65535))
    out.close()
    assert read_image(path).std() > 20
    data = path.read_bytes()
    for kept in (len(data) // 2, len(data) - 5000, len(data) - 40):
        path.write_bytes(data[:kept])
        with pytest.raises(InputError, match=rf"image .*{name} cannot be decoded.*(damaged|truncated)"):
            read_image(path)
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize("suffix", [".png", ".tif"])
def test_sixteen_bits_are_kept_and_tracked_rounded(tmp_path, suffix):
    deep = colors(np.uint16, 65535)
    cv2.imwrite(str(tmp_path / f"a{suffix}"), deep)
    np.testing.assert_array_equal(read_pixels(tmp_path / f"a{suffix}"), deep)
    np.testing.assert_array_equal(read_image(tmp_path / f"a{suffix}"), np.round(deep / 257))


def test_floating_point_tiff_is_linear_light(tmp_path):
    light = colors(np.float32, 4)
    cv2.imwrite(str(tmp_path / "a.tif"), light)
    np.testing.assert_array_equal(read_image(tmp_path / "a.tif"), eight_bits(light))


def test_tone_curve_spends_the_same_levels_on_every_stop():
    grey = 0.18
    assert 255 * tone_curve(np.array([grey]))[0] == pytest.approx(94.8, abs=0.1)
    assert tone_curve(np.array([0, -1, np.nan, -np.inf])).tolist() == [0, 0, 0, 0]
    assert tone_curve(np.array([grey * 128, 1e9, np.inf])).tolist() == pytest.approx([1, 1, 1])
    stops = 255 * np.diff(tone_curve(grey * 2.0 ** np.arange(-1, 8)))
    assert stops.max() < 23.2
    assert stops.min() > 20.5
    light = np.float32([1e-4, 0.01, grey, 1, 20, 1e9, np.nan])
    np.testing.assert_allclose(eight_bits(light), 255 * tone_curve(light), atol=0.52)  # half has 11 bits


@pytest.mark.parametrize(
    ("names", "numbers"),
    [
        (["plate.1001.exr", "plate.1003.exr"], [1001, 1003]),
        (["a_0999.dpx", "a_1000.dpx"], [999, 1000]),
        (["take2_v03.0007.png"], [7]),
        (["1403636579763555584.png", "1403636579813555456.png"], None),  # nanoseconds
        (["1305031102.175304.png", "1305031103.211214.png"], None),  # seconds
        (["a.1.png", "b.2.png"], None),
        (["a.01.png", "a.1.png"], None),
        (["plate_1001_v02.png", "plate_1002_v02.png"], [1001, 1002]),
        (["plate.0999.left.exr", "plate.1000.left.EXR"], [999, 1000]),
        (["1_b.png", "2_b.png", "10_b.png"], [1, 2, 10]),
        (["plate_1001_v02.png"], [1001]),
        (["clip1_v0001.png"], [1]),
        (["plate_v02.png"], [2]),
        (["a1_1.png", "a2_2.png"], None),
        (["cover.png"], None),
        ([], None),
    ],
)
def test_numbers_of_a_sequence(names, numbers):
    assert sequence_numbers(names) == numbers


@pytest.fixture
def sequence(tmp_path) -> Path:
    """plate.1001.png to plate.1012.png without 1004, 1005 and 1009; the brightness is the last two digits."""
    folder = tmp_path / "plates"
    folder.mkdir()
    for number in {*range(1001, 1013)} - {1004, 1005, 1009}:
        cv2.imwrite(str(folder / f"plate.{number}.png"), np.full((HEIGHT, WIDTH, 3), number - 1000, np.uint8))
    return folder


def test_pixel_aspect_of_a_sequence_is_that_of_the_user(sequence):
    assert {frame.pixel_aspect for frame in read_frames(sequence)} == {1.0}
    frames = list(read_frames(sequence, slice(1002, 1007), pixel_aspect=2.0))
    assert [(frame.index, frame.pixel_aspect) for frame in frames] == [(1002, 2.0), (1003, 2.0), (1006, 2.0)]


@pytest.mark.parametrize(
    ("text", "numbers"),
    [
        ("1001:1004", [1001, 1002, 1003]),
        ("1003:1008", [1003, 1006, 1007]),
        ("::3", [1001, 1007, 1010]),
        ("1002::4", [1002, 1006, 1010]),
        (":1003", [1001, 1002]),
    ],
)
def test_range_of_a_sequence_counts_as_its_files_do(sequence, text, numbers):
    frames = list(read_frames(sequence, parse_range(text)))
    assert [frame.index for frame in frames] == numbers
    assert [int(frame.image[0, 0, 0]) + 1000 for frame in frames] == numbers


@pytest.mark.parametrize(
    ("text", "words"),
    [("0:30", "before number 30"), ("1013:", "from number 1013 on"), ("1004:1006", "with the numbers 1004 to 1005")],
)
def test_range_beside_a_sequence_is_refused_with_its_numbers(sequence, text, words):
    with pytest.raises(InputError, match=f"holds no frames {words}; its frames are 1001 to 1012"):
        read_frames(sequence, parse_range(text))


def test_gaps_of_a_sequence_are_named(sequence):
    assert missing_numbers([image.number for image in numbered_images(sequence)]) == "1004 to 1005, 1009"
    assert sequence_of(sequence) == [1001, 1002, 1003, 1006, 1007, 1008, 1010, 1011, 1012]
    assert missing_numbers([1, 3, 5]) == missing_numbers([4]) == missing_numbers([]) == ""
    assert missing_numbers(range(0, 80, 10)) == ""
    assert missing_numbers([2 * k + 100 * (k // 3) for k in range(24)]).endswith(" and 2 more gaps")


@pytest.mark.parametrize(
    ("added", "words"),
    [
        (["plate.1012.jpg"], r"plate\.1012\.jpg beside the sequence plate\.####\.png"),
        (["cover.png", "notes.tif"], r"cover\.png and 1 more files beside the sequence plate\.####\.png"),
        ([f"plate.{k}.jpg" for k in range(1001, 1012)], r"2 sequences \(plate\.####\.jpg, plate\.####\.png\)"),
        ([f"plate.{k:05d}.png" for k in range(1001, 1013)], r"2 sequences \(plate\.#####\.png, plate\.####\.png\)"),
        ([f"R.{k}.png" for k in range(1, 9)], r"2 sequences \(R\.#\.png, plate\.####\.png\)"),
        ([f"plate.{k}.left.png" for k in (1001, 1002)], r"2 sequences \(plate\.####\.left\.png, plate\.####\.png\)"),
        ([f"{k}.{n}.png" for k in "abc" for n in (1, 2)], r"4 sequences \(a\.#\.png, b\.#\.png, c\.#\.png, \.\.\.\)"),
    ],
)
def test_a_folder_with_more_than_a_sequence_is_refused(sequence, added, words):
    for name in added:
        cv2.imwrite(str(sequence / name), np.zeros((HEIGHT, WIDTH, 3), np.uint8))
    with pytest.raises(InputError, match=f"holds {words}; a folder with one of them is expected"):
        read_frames(sequence)


def test_two_paddings_of_the_same_numbers_are_two_sequences():
    names = [name for k in range(1, 25) for name in (f"frame{k}.png", f"frame{k:04d}.png")]
    assert mixture(names) == "2 sequences (frame####.png, frame#.png)"
    assert mixture([f"frame{k}.png" for k in range(1, 25)]) == mixture(["b.png", "a.png"]) == ""


@pytest.mark.parametrize("numbers", [(-4, -3, -2), (-1, 0, 1, 2), (-1,)])
@pytest.mark.parametrize("prefix", ["plate.", "plate_", ""])
def test_negative_numbers_are_refused(tmp_path, prefix, numbers):
    for number in numbers:
        cv2.imwrite(str(tmp_path / f"{prefix}{number:05d}.png"), np.zeros((HEIGHT, WIDTH, 3), np.uint8))
    for read in (read_frames, looks_unordered):
        with pytest.raises(InputError, match=rf"negative numbers \({prefix}-000\d\.png\); numbers from 0 on"):
            read(tmp_path)


def test_a_hyphen_before_a_number_is_no_minus(tmp_path):
    for number in (1001, 1002):
        cv2.imwrite(str(tmp_path / f"plate-{number}.png"), np.zeros((HEIGHT, WIDTH, 3), np.uint8))
    assert [frame.index for frame in read_frames(tmp_path)] == [1001, 1002]


def test_two_sequences_in_a_folder_are_refused(sequence):
    for path in list(sequence.iterdir()):
        (sequence / f"{path.stem}.jpg").write_bytes(path.read_bytes())
    with pytest.raises(InputError, match=r"holds 2 sequences \(plate\.####\.jpg, plate\.####\.png\)"):
        read_frames(sequence)


def test_a_folder_of_other_names_counts_from_0(tmp_path, caplog):
    caplog.set_level(logging.WARNING)
    for name in ("b7.png", "a3.png", "c.png"):
        cv2.imwrite(str(tmp_path / name), np.zeros((HEIGHT, WIDTH, 3), np.uint8))
    assert [(frame.index, frame.name) for frame in read_frames(tmp_path)] == [
        (0, "a3.png"),
        (1, "b7.png"),
        (2, "c.png"),
    ]
    assert caplog.text == ""
