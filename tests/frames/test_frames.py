import errno
import itertools
import logging
import os
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from pathlib import Path

import cv2
import numpy as np
import pytest

from factorsfm.batch.plan import find_videos
from factorsfm.frames import container
from factorsfm.frames import video as video_files
from factorsfm.frames.folders import read_image, unread_images
from factorsfm.frames.frame import Frame
from factorsfm.frames.ranges import parse_range
from factorsfm.frames.reading import read_frames
from factorsfm.frames.silence import quiet_opencv
from factorsfm.frames.tone import eight_bits
from factorsfm.frames.unordered import read_images
from factorsfm.support.errors import InputError

RNG = np.random.default_rng(0)


def image(value: int = 0, width: int = 64, height: int = 48) -> np.ndarray:
    return np.full((height, width, 3), value, dtype=np.uint8)


@pytest.fixture(scope="module")
def video(tmp_path_factory) -> Path:
    """Twelve grey frames whose brightness is 20 times their number, at 25 frames per second."""
    path = tmp_path_factory.mktemp("video") / "shot.mp4"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"mp4v"), 25, (64, 48))
    for index in range(12):
        writer.write(image(20 * index))
    writer.release()
    return path


def test_video_frames_come_in_order_with_their_times(video):
    frames = list(read_frames(video))
    assert [frame.index for frame in frames] == list(range(12))
    assert [frame.name for frame in frames[:2]] == ["000000", "000001"]
    for frame in frames:
        assert frame.image.mean() == pytest.approx(20 * frame.index, abs=8)
        assert frame.timestamp == pytest.approx(frame.index / 25, abs=1e-6)


@pytest.mark.parametrize(
    ("text", "indices"),
    [("0:12", range(12)), ("3:10:3", (3, 6, 9)), ("10:99", (10, 11)), (":2", (0, 1)), ("::5", (0, 5, 10))],
)
def test_range_of_a_video_keeps_indices_and_content(video, text, indices):
    frames = list(read_frames(str(video), parse_range(text)))
    assert [frame.index for frame in frames] == list(indices)
    for frame in frames:
        assert frame.image.mean() == pytest.approx(20 * frame.index, abs=8)
        assert frame.timestamp == pytest.approx(frame.index / 25, abs=1e-6)


@pytest.fixture(scope="module")
def long_video(tmp_path_factory) -> Path:
    """250 frames with their number in two brightnesses, the lower four bits on the left."""
    path = tmp_path_factory.mktemp("video") / "film.mp4"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"mp4v"), 25, (64, 48))
    for index in range(250):
        writer.write(np.hstack([image(16 * (index % 16), 32), image(16 * (index // 16), 32)]))
    writer.release()
    return path


def numbers(frames) -> list[int]:
    """The numbers that `long_video` has written into the images."""
    sides = [(frame.image[:, 4:28].mean(), frame.image[:, 36:60].mean()) for frame in frames]
    return [round(left / 16) + 16 * round(right / 16) for left, right in sides]


@pytest.mark.parametrize("sought", [True, False])
def test_a_late_range_of_a_long_video_is_exact_though_most_of_it_is_not_decoded(long_video, monkeypatch, sought):
    decoded = []
    frames_of = container.decoded_with_damage

    def counted(file, stream):
        for frame, damaged in frames_of(file, stream):
            decoded.append(frame.pts)
            yield frame, damaged

    for module in (container, video_files):
        monkeypatch.setattr(module, "decoded_with_damage", counted)
    if not sought:  # two frames at one time: their packets do not tell them apart
        monkeypatch.setattr(video_files, "_frame_times", lambda *file: np.zeros(0))
    frames = list(read_frames(long_video, slice(200, 230, 10)))
    assert [frame.index for frame in frames] == numbers(frames) == [200, 210, 220]
    assert [frame.timestamp for frame in frames] == pytest.approx([8.0, 8.4, 8.8], abs=1e-6)
    assert len(decoded) < 90 if sought else len(decoded) >= 221


def test_parse_range():
    assert parse_range("2:8") == slice(2, 8, 1)
    assert parse_range("2:8:3") == slice(2, 8, 3)
    assert parse_range("7:") == slice(7, None, 1)


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("", "START:STOP"),
        (":", "START:STOP"),
        ("5", "START:STOP"),
        ("a:b", "START:STOP"),
        ("1:2:3:4", "START:STOP"),
        ("1.5:3", "START:STOP"),
        ("-3:5", "START:STOP"),
        ("0:-1", "START:STOP"),
        ("0:9:0", "step 0"),
        ("5:5", "empty"),
        ("9:3", "empty"),
    ],
)
def test_bad_range_is_refused(text, reason):
    with pytest.raises(InputError, match=reason):
        parse_range(text)


@pytest.mark.parametrize(
    ("frames", "reason"),
    [
        (slice(-3, None), "negative"),
        (slice(0, 9, -1), "negative"),
        (slice(4, 4), "empty"),
        (slice(0, 9, 0), "step 0"),
    ],
)
def test_bad_slice_is_refused_at_the_call(video, frames, reason):
    with pytest.raises(InputError, match=reason):
        read_frames(video, frames)


def test_folder_in_natural_order_without_other_files(tmp_path):
    names = [
        "img10.png",
        "img2.PNG",
        "img1.jpg",
        "img03.bmp",
        "Img4.tiff",
        "img5.webp",
        "img6.JPEG",
        "img7.tif",
    ]
    for value, name in enumerate(names):
        cv2.imwrite(str(tmp_path / name), image(20 * value))
    (tmp_path / "notes.txt").write_text("no image")
    (tmp_path / "._img1.jpg").write_bytes(b"resource fork")
    (tmp_path / "folder.png").mkdir()
    frames = list(read_frames(tmp_path))
    expected = [
        "img1.jpg",
        "img2.PNG",
        "img03.bmp",
        "Img4.tiff",
        "img5.webp",
        "img6.JPEG",
        "img7.tif",
        "img10.png",
    ]
    assert [frame.name for frame in frames] == expected
    assert [frame.index for frame in frames] == list(range(8))
    assert all(frame.timestamp is None for frame in frames)
    for frame in frames:
        assert frame.image.mean() == pytest.approx(20 * names.index(frame.name), abs=2)
    assert [frame.name for frame in read_frames(tmp_path, slice(1, 8, 3))] == [
        "img2.PNG",
        "img5.webp",
        "img10.png",
    ]


def test_grey_16_bit_and_alpha_files_become_8_bit_bgr(tmp_path):
    cv2.imwrite(str(tmp_path / "0.png"), image(100)[..., 0])
    cv2.imwrite(str(tmp_path / "1.png"), image()[..., 0].astype(np.uint16) + 100 * 256)
    cv2.imwrite(str(tmp_path / "2.png"), np.dstack([image(100), image(50)[..., 0]]))
    for frame in read_frames(tmp_path):
        assert frame.image.dtype == np.uint8
        np.testing.assert_array_equal(frame.image, image(100))


def test_exif_orientation_is_applied(tmp_path):
    path = tmp_path / "phone.jpg"
    cv2.imwrite(str(path), image(width=64, height=48))
    jpeg = path.read_bytes()
    tiff = b"MM\0*\0\0\0\x08" + b"\0\x01" + b"\x01\x12\0\x03\0\0\0\x01\0\x06\0\0" + b"\0\0\0\0"
    exif = b"Exif\0\0" + tiff
    path.write_bytes(jpeg[:2] + b"\xff\xe1" + (len(exif) + 2).to_bytes(2, "big") + exif + jpeg[2:])
    (frame,) = read_frames(tmp_path)
    assert frame.image.shape == (64, 48, 3)


def test_arrays_are_converted_and_numbered():
    grey = RNG.integers(0, 255, (48, 64), dtype=np.uint8)
    deep = grey.astype(np.uint16) * 257 + 99  # less than half of a grey level more
    alpha = np.dstack([grey, grey, grey, grey])
    frames = list(read_frames([grey, deep, alpha, grey[..., None]], slice(0, 4)))
    assert [(frame.index, frame.name, frame.timestamp) for frame in frames[:2]] == [
        (0, "000000", None),
        (1, "000001", None),
    ]
    for frame in frames:
        np.testing.assert_array_equal(frame.image, np.dstack([grey, grey, grey]))


def test_frame_objects_keep_their_identity():
    source = [Frame(index, image(index), f"f{index}.png", index / 24) for index in (10, 11, 12)]
    frames = list(read_frames(source, slice(1, None)))
    assert [(frame.index, frame.name, frame.timestamp) for frame in frames] == [
        (11, "f11.png", 11 / 24),
        (12, "f12.png", 0.5),
    ]


def test_endless_iterable_is_read_no_further_than_needed():
    taken = itertools.count()
    endless = (image(next(taken)) for _ in itertools.count())
    assert [frame.index for frame in read_frames(endless, slice(2, 7, 2))] == [2, 4, 6]
    assert next(taken) == 7


@pytest.mark.parametrize(
    ("source", "reason"),
    [
        ("nowhere.mp4", "nowhere.mp4 does not exist"),
        (np.zeros((48, 64, 3), np.uint8), "single image"),
        (np.zeros((48, 64), np.uint8), "single image"),
        (None, "NoneType"),
        (7, "int"),
    ],
)
def test_impossible_source_is_refused_at_the_call(source, reason):
    with pytest.raises(InputError, match=reason):
        read_frames(source)


@pytest.mark.parametrize("content", [b"", b"hello\n" * 100])
def test_file_that_is_no_video_is_refused_at_the_call(tmp_path, content, capfd):
    path = tmp_path / "shot1.mp4"
    path.write_bytes(content)
    with pytest.raises(InputError, match=r"shot1\.mp4 cannot be decoded as a video"):
        read_frames(path)
    assert capfd.readouterr().err == ""


def test_what_is_neither_file_nor_folder_is_said_to_be_so(tmp_path):
    os.mkfifo(tmp_path / "pipe.mp4")
    for path in (tmp_path / "pipe.mp4", Path(os.devnull)):
        for read in (read_frames, find_videos):
            with pytest.raises(InputError, match=f"{path} is neither a file nor a folder; a video file or a folder of"):
                read(path)


def test_a_video_that_cannot_be_opened_is_not_said_to_be_damaged(tmp_path, monkeypatch):
    path = tmp_path / "shot.mp4"
    with pytest.raises(InputError, match=r"shot\.mp4 cannot be read: No such file or directory"):
        video_files.open_video(path)
    path.write_bytes(b"locked")

    def locked(*_: object) -> None:
        raise PermissionError(errno.EACCES, "Permission denied", str(path))

    monkeypatch.setattr(Path, "open", locked)
    with pytest.raises(InputError, match=r"shot\.mp4 cannot be read: Permission denied"):
        read_frames(path)


def test_pixels_of_another_type_are_named(tmp_path):
    cv2.imwrite(str(tmp_path / "0.tif"), image(50).astype(np.float64))
    with pytest.raises(InputError, match=r"0\.tif has pixels of float64; 8 or 16 bits a channel"):
        next(read_frames(tmp_path))


def test_a_video_that_was_cut_off_says_so(tmp_path, caplog):
    """AVI is read without its index, which stands at the end."""
    path = tmp_path / "shot.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 25, (64, 48))
    for _ in range(20):
        writer.write(RNG.integers(0, 255, (48, 64, 3), np.uint8))
    writer.release()
    with caplog.at_level(logging.WARNING):
        assert len(list(read_frames(path))) == 20
    assert not caplog.records
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    assert 1 < (read := len(list(read_frames(path)))) < 12
    assert f"shot.avi: only {read} of the 20 frames" in caplog.text


def test_images_in_formats_that_are_not_read_are_named(tmp_path):
    for number in range(4):
        (tmp_path / f"IMG_{number:04d}.HEIC").write_bytes(b"\0\0\0\x18ftypheic")
    hint = r"holds no images \(.*\); IMG_0000.HEIC, IMG_0001.HEIC, IMG_0002.HEIC, …: convert them$"
    with pytest.raises(InputError, match=hint):
        read_frames(tmp_path)
    with pytest.raises(InputError, match=hint):
        list(read_images(tmp_path))
    with pytest.raises(InputError, match=r"IMG_0000\.HEIC is a single image"):
        read_frames(tmp_path / "IMG_0000.HEIC")
    cv2.imwrite(str(tmp_path / "IMG_0001.JPG"), image())  # as cameras write both
    cv2.imwrite(str(tmp_path / "IMG_0003.JPG"), image())
    assert unread_images(tmp_path) == ["IMG_0000.HEIC", "IMG_0002.HEIC"]


@pytest.mark.parametrize("pattern", ["a.%04d.png", "a.####.png", "a.*.png", "a.100[1-9].png"])
def test_a_pattern_of_names_is_refused_as_one(tmp_path, pattern):
    cv2.imwrite(str(tmp_path / "a.1001.png"), image())
    with pytest.raises(InputError, match=r"is a pattern of names in .*; a video file or a folder of images"):
        read_frames(tmp_path / pattern)
    with pytest.raises(InputError, match="does not exist"):
        read_frames(tmp_path / "nowhere" / pattern)


def test_single_image_file_is_refused_at_the_call(tmp_path):
    cv2.imwrite(str(tmp_path / "one.png"), image())
    with pytest.raises(InputError, match=r"one\.png is a single image"):
        read_frames(tmp_path / "one.png")


def test_folder_without_images_is_refused_at_the_call(tmp_path):
    (tmp_path / "notes.txt").write_text("no image")
    with pytest.raises(InputError, match="holds no images"):
        read_frames(tmp_path)


@pytest.mark.parametrize("suffix", [".jpg", ".png", ".webp", ".bmp", ".tif"])
@pytest.mark.parametrize("kept", [0.0, 0.3, 0.95])
def test_truncated_image_is_named(tmp_path, suffix, kept, capfd):
    noise = RNG.integers(0, 255, (48, 64, 3), dtype=np.uint8)
    for index in range(2):
        cv2.imwrite(str(tmp_path / f"{index}{suffix}"), noise)
    broken = tmp_path / f"1{suffix}"
    data = broken.read_bytes()
    broken.write_bytes(data[: int(kept * len(data))])
    frames = read_frames(tmp_path)
    assert next(frames).name == f"0{suffix}"
    with pytest.raises(InputError, match=rf"1\{suffix} .*truncated"):
        next(frames)
    assert capfd.readouterr().err == ""


def test_jpeg_with_thumbnail_or_trailing_data_is_complete(tmp_path):
    path = tmp_path / "a.jpg"
    cv2.imwrite(str(path), image(90))
    jpeg = path.read_bytes()
    thumbnail = b"\xff\xe1" + (len(jpeg) + 2).to_bytes(2, "big") + jpeg
    path.write_bytes(jpeg[:2] + thumbnail + jpeg[2:] + b"\xff\xda trailing")
    assert next(read_frames(tmp_path)).image.mean() == pytest.approx(90, abs=2)
    path.write_bytes(jpeg[:2] + thumbnail + jpeg[2:-40])
    with pytest.raises(InputError, match="truncated"):
        next(read_frames(tmp_path))


def with_hole(data: bytes, share: float) -> bytes:
    """The same file with zeros from its middle on."""
    middle, size = len(data) // 2, int(share * len(data))
    return data[:middle] + bytes(size) + data[middle + size :]


@pytest.mark.parametrize(
    "options",
    [
        [],
        [cv2.IMWRITE_JPEG_OPTIMIZE, 1],
        [cv2.IMWRITE_JPEG_PROGRESSIVE, 1],
        [cv2.IMWRITE_JPEG_RST_INTERVAL, 4],
        [cv2.IMWRITE_JPEG_QUALITY, 30],
    ],
)
@pytest.mark.parametrize("share", [0.1, 0.25])
def test_a_jpeg_with_a_hole_is_damaged(tmp_path, options, share, capfd):
    picture = cv2.GaussianBlur(RNG.integers(0, 255, (480, 640, 3), dtype=np.uint8), (0, 0), 2)
    data = cv2.imencode(".jpg", picture, options)[1].tobytes()
    path = tmp_path / "a.jpg"
    path.write_bytes(data)
    assert read_image(path).shape == picture.shape
    path.write_bytes(with_hole(data, share))
    with pytest.raises(InputError, match=r"image .*a\.jpg is damaged"):
        read_image(path)
    assert capfd.readouterr().err == ""


@pytest.mark.parametrize("value", [0, 128, 255])
@pytest.mark.parametrize(
    "options",
    [
        [],
        [cv2.IMWRITE_JPEG_OPTIMIZE, 1],
        [cv2.IMWRITE_JPEG_PROGRESSIVE, 1],
        [cv2.IMWRITE_JPEG_RST_INTERVAL, 4, cv2.IMWRITE_JPEG_OPTIMIZE, 1],
    ],
)
def test_a_jpeg_of_one_colour_or_with_padding_is_whole(tmp_path, value, options):
    """Optimal codes of an image of one colour are all zeros, and a scan may be filled up."""
    path = tmp_path / "a.jpg"
    data = cv2.imencode(".jpg", image(value, 640, 480), options)[1].tobytes()
    path.write_bytes(data)
    np.testing.assert_allclose(read_image(path), value, atol=1)
    path.write_bytes(data[:-2] + bytes(500) + data[-2:] + bytes(500))
    np.testing.assert_allclose(read_image(path), value, atol=1)


def test_a_marker_that_no_scan_holds_is_damage(tmp_path):
    data = cv2.imencode(".jpg", RNG.integers(0, 255, (48, 64, 3), dtype=np.uint8))[1].tobytes()
    middle = len(data) // 2
    (tmp_path / "a.jpg").write_bytes(data[:middle] + b"\xff\x07" + data[middle + 2 :])
    with pytest.raises(InputError, match=r"image .*a\.jpg is damaged"):
        read_image(tmp_path / "a.jpg")


@pytest.mark.parametrize("compression", ["LZW", "ADOBE_DEFLATE", "PACKBITS"])
@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_a_tiff_with_a_hole_is_damaged(tmp_path, compression, dtype, capfd):
    picture = cv2.GaussianBlur(RNG.integers(0, 255, (240, 320, 3), dtype=np.uint8), (0, 0), 2).astype(dtype)
    kind = [cv2.IMWRITE_TIFF_COMPRESSION, getattr(cv2, f"IMWRITE_TIFF_COMPRESSION_{compression}")]
    data = cv2.imencode(".tif", picture, kind)[1].tobytes()
    path = tmp_path / "a.tif"
    path.write_bytes(data)
    np.testing.assert_array_equal(read_image(path), eight_bits(picture))
    path.write_bytes(with_hole(data, 0.1))
    with pytest.raises(InputError, match=r"image .*a\.tif .*damaged"):
        read_image(path)
    assert capfd.readouterr().err == ""


@pytest.mark.parametrize("quality", [20, 80, 100, 101])  # the last is without loss
def test_a_webp_with_a_hole_is_damaged_and_one_of_one_colour_is_whole(tmp_path, quality):
    picture = cv2.GaussianBlur(RNG.integers(0, 255, (480, 640, 3), dtype=np.uint8), (0, 0), 1)
    path = tmp_path / "a.webp"
    data = cv2.imencode(".webp", picture, [cv2.IMWRITE_WEBP_QUALITY, quality])[1].tobytes()
    path.write_bytes(data)
    assert read_image(path).shape == picture.shape
    path.write_bytes(with_hole(data, 0.25))
    with pytest.raises(InputError, match=r"image .*a\.webp is damaged"):
        read_image(path)
    whole = [image(value, 2048, 1536) for value in (0, 128, 255)]
    half = np.vstack([picture, np.zeros_like(picture)])
    clear = np.dstack([half, np.zeros(half.shape[:2], np.uint8)])  # with zeros of another kind
    for shown in (*whole, half, clear):
        path.write_bytes(cv2.imencode(".webp", shown, [cv2.IMWRITE_WEBP_QUALITY, quality])[1].tobytes())
        assert read_image(path).shape == (*shown.shape[:2], 3)


def test_a_png_with_a_hole_is_damaged(tmp_path, capfd):
    data = cv2.imencode(".png", RNG.integers(0, 255, (48, 64, 3), dtype=np.uint8))[1].tobytes()
    (tmp_path / "a.png").write_bytes(with_hole(data, 0.1))
    with pytest.raises(InputError, match=r"image .*a\.png is damaged"):
        read_image(tmp_path / "a.png")
    text = b"tEXtComment\0x"  # a wrong checksum of what nobody needs
    (tmp_path / "a.png").write_bytes(data[:33] + (len(text) - 4).to_bytes(4, "big") + text + bytes(4) + data[33:])
    assert read_image(tmp_path / "a.png").shape == (48, 64, 3)


def test_other_size_is_named(tmp_path):
    for index, width in enumerate((64, 64, 32)):
        cv2.imwrite(str(tmp_path / f"img{index}.png"), image(width=width))
    frames = read_frames(tmp_path)
    assert [next(frames).index, next(frames).index] == [0, 1]
    with pytest.raises(InputError, match=r"frame 2 \(img2\.png\) .* 32x48 .*img0\.png.* 64x48"):
        next(frames)


@pytest.mark.parametrize(
    "bad", [image().astype(np.float32), "text", np.zeros((4, 4, 2), np.uint8), np.zeros(3, np.uint8)]
)
def test_unusable_array_is_refused(bad):
    frames = read_frames([image(), bad])
    next(frames)
    with pytest.raises(InputError, match="frame 1 "):
        next(frames)


def test_no_frame_at_all_is_an_error(video):
    with pytest.raises(InputError, match="holds no frames from number 50 on"):
        list(read_frames(video, slice(50, 60)))
    with pytest.raises(InputError, match="the sequence of images holds no frames"):
        list(read_frames([]))


def test_two_threads_that_silence_opencv_restore_its_level():
    before = cv2.utils.logging.getLogLevel()
    with ThreadPoolExecutor(1) as other, ExitStack() as first:
        first.enter_context(quiet_opencv())
        second = quiet_opencv()
        other.submit(second.__enter__).result()
        first.close()
        assert cv2.utils.logging.getLogLevel() == cv2.utils.logging.LOG_LEVEL_SILENT
        other.submit(second.__exit__, None, None, None).result()
    assert cv2.utils.logging.getLogLevel() == before
