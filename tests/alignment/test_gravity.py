"""Gravity in photographs: files as phones and drones write them, made here byte by byte."""

import struct

import cv2
import numpy as np
import pycolmap
import pytest

from factorsfm.alignment.gravity import down_in_photo, up_from_photos

UPRIGHT, ON_ITS_SIDE, LENS_DOWN = (0.0, -1.0, 0.0), (-1.0, 0.0, 0.0), (0.0, 0.0, -1.0)
DOWN, AHEAD = (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)


def directory(entries, offset, order=">"):
    """A directory of tags at an offset: its entries, then the values that have no room in them."""
    rows, values = [], b""
    behind = offset + 2 + 12 * len(entries) + 4
    for tag, kind, count, data in entries:
        place = data.ljust(4, b"\0")
        if len(data) > 4:
            place = struct.pack(order + "I", behind + len(values))
            values += data
        rows.append(struct.pack(order + "HHI", tag, kind, count) + place)
    return struct.pack(order + "H", len(entries)) + b"".join(rows) + struct.pack(order + "I", 0) + values


def phone_exif(acceleration, orientation=1, lens=b"iPhone 12 back camera 4.2mm f/1.6\0", order=">"):
    numbers = [number for value in acceleration for number in (round(1e6 * value), 10**6)]
    note = b"Apple iOS\0\0\1MM"
    note += directory([(1, 9, 1, struct.pack(">i", 14)), (8, 10, 3, struct.pack(">6i", *numbers))], len(note))
    mark = b"MM\0*" if order == ">" else b"II*\0"
    main = [(0x0112, 3, 1, struct.pack(order + "H", orientation)), (0x8769, 4, 1, struct.pack(order + "I", 100))]
    head = (mark + struct.pack(order + "I", 8) + directory(main, 8, order)).ljust(100, b"\0")
    return head + directory([(0x927C, 7, len(note), note), (0xA434, 2, len(lens), lens)], 100, order)


def drone_xmp(pitch, roll, *, as_attributes=True):
    if as_attributes:
        said = f'drone-dji:GimbalRollDegree="{roll:+.2f}" drone-dji:GimbalPitchDegree="{pitch:+.2f}"'
    else:
        said = (
            f"<drone-dji:GimbalRollDegree>{roll}</drone-dji:GimbalRollDegree>"
            f"<drone-dji:GimbalPitchDegree>{pitch}</drone-dji:GimbalPitchDegree>"
        )
    return f"http://ns.adobe.com/xap/1.0/\0<x:xmpmeta>{said}</x:xmpmeta>".encode()


@pytest.fixture
def photo(tmp_path):
    """Writes a photograph with EXIF data and XMP."""

    def write(exif=b"", xmp=b""):
        path = tmp_path / "photo.jpg"
        image = np.random.default_rng(0).integers(0, 256, (48, 64, 3), np.uint8)
        blocks = [(cv2.IMAGE_METADATA_EXIF, exif)] if exif else []
        kinds, data = [kind for kind, _ in blocks], [np.frombuffer(block, np.uint8) for _, block in blocks]
        assert cv2.imwriteWithMetadata(str(path), image, kinds, data)
        if xmp:
            whole = path.read_bytes()
            path.write_bytes(whole[:2] + b"\xff\xe1" + struct.pack(">H", len(xmp) + 2) + xmp + whole[2:])
        return path

    return write


def shown_as(orientation):
    """A camera of the format in which a photograph of 64x48 pixels is shown."""
    size = (64, 48) if orientation in (1, 3) else (48, 64)
    return pycolmap.Camera.create_from_model_name(0, "PINHOLE", 60.0, *size)


@pytest.mark.parametrize("order", [">", "<"])
@pytest.mark.parametrize(
    ("acceleration", "orientation", "down"),
    [
        (ON_ITS_SIDE, 1, DOWN),  # the wide picture, the phone's top at the left
        (UPRIGHT, 6, DOWN),
        ((1.0, 0.0, 0.0), 3, DOWN),
        ((0.0, 1.0, 0.0), 8, DOWN),
        (LENS_DOWN, 1, AHEAD),
        (LENS_DOWN, 6, AHEAD),
        ((0.0, -0.6, -0.8), 6, (0.0, 0.6, 0.8)),
        ((0.0, -0.6, 0.8), 6, (0.0, 0.6, -0.8)),
        ((0.6, -0.8, 0.0), 6, (0.6, 0.8, 0.0)),  # turned clockwise in the hand
    ],
)
def test_a_phone_says_where_down_is(photo, acceleration, orientation, down, order):
    found = down_in_photo(photo(phone_exif(acceleration, orientation, order=order)), shown_as(orientation))
    np.testing.assert_allclose(found, down, atol=1e-6)


def test_an_upright_photograph_among_others_is_turned_left(photo):
    """Down is then at the right."""
    found = down_in_photo(photo(phone_exif(UPRIGHT, 6)), shown_as(1))
    np.testing.assert_allclose(found, (1.0, 0.0, 0.0), atol=1e-6)


def views(photo, downs, poses):
    for down, pose in zip(downs, poses, strict=True):  # the file is read before the next one takes its place
        yield photo(phone_exif((-down[1], -down[0], -down[2]))), shown_as(1), pose


def poses(count, rng):
    return [pycolmap.Rigid3d(pycolmap.Rotation3d(rng.normal(size=3)), rng.normal(size=3)) for _ in range(count)]


def test_up_is_the_mean_of_what_photographs_say(photo):
    rng = np.random.default_rng(0)
    up, cameras = np.array([0.36, -0.8, 0.48]), poses(12, rng)
    downs = [pose.rotation.matrix() @ -up + 0.02 * rng.normal(size=3) for pose in cameras]
    found, std = up_from_photos(views(photo, downs, cameras))
    assert 0.01 < np.degrees(np.arccos(found @ up)) < 1.0
    assert 1.0 < std < 1.3
    assert up_from_photos(views(photo, downs[:1], cameras[:1])) is None


def test_photographs_that_disagree_say_nothing(photo):
    rng = np.random.default_rng(0)
    cameras = poses(6, rng)
    assert up_from_photos(views(photo, [np.array(DOWN)] * 6, cameras)) is None


@pytest.mark.parametrize("as_attributes", [True, False])
@pytest.mark.parametrize(
    ("pitch", "roll", "down"),
    [
        (0, 0, DOWN),
        (-90, 0, AHEAD),
        (-30, 0, (0, np.sqrt(0.75), 0.5)),
        (0, 10, (np.sin(np.radians(10)), np.cos(np.radians(10)), 0)),
    ],
)
def test_a_drone_says_where_down_is(photo, pitch, roll, down, as_attributes):
    found = down_in_photo(photo(xmp=drone_xmp(pitch, roll, as_attributes=as_attributes)), shown_as(1))
    np.testing.assert_allclose(found, down, atol=1e-6)


@pytest.mark.parametrize(
    "exif",
    [
        b"",
        phone_exif(UPRIGHT, lens=b"iPhone 12 front camera 2.7mm f/2.2\0"),
        phone_exif((0.0, -2.0, 0.0)),  # shaken
        phone_exif(UPRIGHT, orientation=5),  # mirrored
        phone_exif(UPRIGHT, orientation=77),
        phone_exif(UPRIGHT).replace(b"Apple iOS", b"Other iOS"),
    ],
)
def test_others_do_not(photo, exif):
    assert down_in_photo(photo(exif), shown_as(1)) is None


def test_damaged_data_say_nothing_or_the_same(photo):
    whole = phone_exif(UPRIGHT, 6)
    for length in range(10, len(whole), 7):
        assert down_in_photo(photo(whole[:length]), shown_as(6)) is None or length > len(whole) - 60
    rng = np.random.default_rng(0)
    for _ in range(200):
        torn = bytearray(whole)
        for place in rng.integers(8, len(torn), 4):
            torn[place] = rng.integers(256)
        found = down_in_photo(photo(bytes(torn)), shown_as(6))
        assert found is None or np.linalg.norm(found) == pytest.approx(1.0)
