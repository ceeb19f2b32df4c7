"""Video files as they come: codecs, containers, times, fields, pixel aspect, orientation and colour."""

from fractions import Fraction

import av
import cv2
import numpy as np
import pytest

from factorsfm.frames.ranges import parse_range
from factorsfm.frames.reading import read_frames
from factorsfm.support.errors import InputError
from tests.video_files import (
    BT709,
    BT2020,
    FORMATS,
    FULL,
    HLG,
    LIMITED,
    PQ,
    interlaced,
    moving_texture,
    woven,
    write_video,
)

LOSSLESS = {"codec": "ffv1", "pixels": "bgr0"}


def grey(image: np.ndarray) -> np.ndarray:
    return image.astype(np.float64).mean(axis=2)


@pytest.mark.parametrize(("suffix", "codec", "pixels", "options"), FORMATS, ids=lambda value: str(value))
def test_every_codec_and_container_shows_the_same_images_at_their_times(tmp_path, suffix, codec, pixels, options):
    images = moving_texture(12)
    frames = list(read_frames(write_video(tmp_path / f"shot{suffix}", images, codec, pixels, options=options)))
    assert [frame.index for frame in frames] == list(range(12))
    assert [frame.timestamp for frame in frames] == pytest.approx(np.arange(12) / 25, abs=1e-3)
    for frame, image in zip(frames, images, strict=True):
        assert np.abs(grey(frame.image) - grey(image)).mean() < 3.0
        assert abs((grey(frame.image) - grey(image)).mean()) < 2.0


def test_av1(tmp_path, capfd):
    images = moving_texture(12)
    path = write_video(tmp_path / "shot.mkv", images, "libsvtav1", "yuv420p10le")
    capfd.readouterr()  # of the encoder
    frames = list(read_frames(path))
    assert len(frames) == 12
    assert max(np.abs(grey(frame.image) - grey(image)).mean() for frame, image in zip(frames, images, strict=True)) < 3
    assert capfd.readouterr().err == ""


def test_a_codec_without_decoder_is_named(tmp_path, capfd):
    path = write_video(tmp_path / "shot.avi", moving_texture(3), "mjpeg", "yuvj420p")
    path.write_bytes(path.read_bytes().replace(b"MJPG", b"XYZW"))
    with pytest.raises(InputError, match=r"shot\.avi .* no decoder for its codec \(XYZW\); convert it to H\.264"):
        read_frames(path)
    assert capfd.readouterr().err == ""


def test_a_file_without_picture_is_refused(tmp_path):
    with av.open(str(tmp_path / "sound.mp4"), "w") as container:
        stream = container.add_stream("aac", rate=48000)
        sound = av.AudioFrame.from_ndarray(np.zeros((2, 1024), np.float32), format="fltp", layout="stereo")
        sound.sample_rate = 48000
        container.mux(stream.encode(sound))
        container.mux(stream.encode(None))
    with pytest.raises(InputError, match=r"sound\.mp4 .* holds no picture"):
        read_frames(tmp_path / "sound.mp4")


def test_damage_inside_a_file_says_nothing_on_standard_error(tmp_path, capfd):
    path = write_video(tmp_path / "shot.mp4", moving_texture(40))
    data = bytearray(path.read_bytes())
    data[len(data) // 2 : len(data) // 2 + 200] = bytes(200)
    path.write_bytes(data)
    assert 10 < len(list(read_frames(path))) <= 40
    assert capfd.readouterr().err == ""


def test_uneven_times_are_kept(tmp_path):
    times = [0, 4, 8, 12, 20, 28, 36]
    path = write_video(tmp_path / "shot.mkv", moving_texture(7), **LOSSLESS, times=times)
    assert [frame.timestamp for frame in read_frames(path)] == pytest.approx(np.array(times) / 100, abs=1e-3)


def test_a_file_that_grows_is_read_as_far_as_it_was_and_warned_of(tmp_path, caplog):
    path = write_video(tmp_path / "shot.ts", moving_texture(40), "mpeg2video")
    data = path.read_bytes()
    path.write_bytes(data[: len(data) // 2])
    frames = read_frames(path)
    next(frames)
    count = 1 + sum(1 for _ in frames)
    assert not caplog.messages
    path.write_bytes(data[: len(data) // 2])
    frames = read_frames(path)
    next(frames)
    with path.open("ab") as file:
        file.write(data[len(data) // 2 :])
    assert count <= 1 + sum(1 for _ in frames) <= 40
    assert any("more was written to it while it was read" in message for message in caplog.messages)


def test_a_file_that_vanishes_with_its_network_is_no_shorter_file(tmp_path, monkeypatch):
    path = write_video(tmp_path / "shot.mkv", moving_texture(30), **LOSSLESS)
    frames = read_frames(path)
    next(frames)

    def fail(_: object) -> None:
        raise av.error.OSError(5, "Input/output error")

    monkeypatch.setattr("factorsfm.frames.video._packet_frames", fail)
    path.unlink()
    with pytest.raises(InputError, match=r"shot\.mkv cannot be read any more: No such file"):
        list(frames)


# --- fields -------------------------------------------------------------------------------------------------------


def half_lines(image: np.ndarray) -> np.ndarray:
    """The mean of each two lines: the image of half the lines."""
    lines = grey(image)
    return 0.5 * (lines[::2] + lines[1::2])


@pytest.mark.parametrize("top_first", [True, False])
@pytest.mark.parametrize(("suffix", "codec"), [(".mp4", "libx264"), (".mpg", "mpeg2video"), (".mxf", "mpeg2video")])
def test_fields_are_taken_apart_in_the_order_of_time(tmp_path, suffix, codec, top_first):
    moments = moving_texture(16, step=3.0)
    path = interlaced(tmp_path / f"shot{suffix}", moments, codec, top_first=top_first)
    frames = list(read_frames(path))
    assert [frame.index for frame in frames] == list(range(16))
    assert frames[0].image.shape == (120, 320, 3)
    assert frames[0].pixel_aspect == 0.5
    assert [frame.timestamp for frame in frames] == pytest.approx(np.arange(16) / 50, abs=1e-3)
    for frame, image in zip(frames, moments, strict=True):
        error = np.abs(grey(frame.image) - half_lines(image))[2:-2, 2:-2].mean()
        assert error < 3.0
        moved = np.abs(grey(frame.image) - half_lines(np.roll(image, 3, axis=1)))[2:-2, 8:-8].mean()
        assert moved > 2 * error  # the field before or after would not do


def test_a_field_lies_on_the_lines_that_both_fields_share(tmp_path):
    """Between the fields of a still image there is no vertical displacement; as they are stored, half a line."""
    moments = moving_texture(8, step=0.0)
    frames = list(read_frames(interlaced(tmp_path / "shot.mp4", moments, "libx264", top_first=True)))
    shift, _ = cv2.phaseCorrelate(grey(frames[2].image), grey(frames[3].image))
    assert abs(shift[1]) < 0.05
    raw = [grey(moments[0])[k::2] for k in (0, 1)]
    assert abs(cv2.phaseCorrelate(*raw)[0][1]) > 0.3


def test_a_range_counts_fields(tmp_path):
    path = interlaced(tmp_path / "shot.mp4", moving_texture(16, step=3.0), "libx264", top_first=True)
    everything = list(read_frames(path))
    for text in ("3:10:3", "5:6", "14:"):
        chosen = list(read_frames(path, parse_range(text)))
        expected = everything[parse_range(text)]
        assert [frame.index for frame in chosen] == [frame.index for frame in expected]
        for frame, same in zip(chosen, expected, strict=True):
            np.testing.assert_array_equal(frame.image, same.image)


def test_blended_fields_keep_all_lines_and_are_not_combed(tmp_path):
    path = interlaced(tmp_path / "shot.mp4", moving_texture(16, step=4.0), "libx264", top_first=True)
    frames = list(read_frames(path, fields="blend"))
    assert len(frames) == 8
    assert frames[0].image.shape == (240, 320, 3)
    assert frames[0].pixel_aspect == 1.0
    combs = np.abs(np.diff(grey(frames[3].image), 2, axis=0)).mean()
    combed = np.abs(np.diff(grey(woven(moving_texture(8, 4.0), top_first=True)[3]), 2, axis=0)).mean()
    assert combs < 0.1 * combed


def test_film_that_is_stored_as_interlaced_stays_whole(tmp_path):
    film = [image for image in moving_texture(12, step=3.0) for _ in range(2)]
    frames = list(read_frames(interlaced(tmp_path / "shot.mp4", film, "libx264", top_first=True)))
    assert len(frames) == 12
    assert frames[0].image.shape == (240, 320, 3)
    apart = list(read_frames(tmp_path / "shot.mp4", fields="apart"))
    assert len(apart) == 24


def test_progressive_video_is_taken_apart_on_demand(tmp_path):
    path = write_video(tmp_path / "shot.mkv", woven(moving_texture(8, 3.0), top_first=True), **LOSSLESS)
    assert len(list(read_frames(path))) == 4
    assert len(list(read_frames(path, fields="apart"))) == 8


def test_unknown_ways_to_read_are_refused(tmp_path):
    path = write_video(tmp_path / "shot.mkv", moving_texture(2), **LOSSLESS)
    with pytest.raises(InputError, match="unknown fields 'whole', expected one of auto, apart, blend"):
        read_frames(path, fields="whole")
    with pytest.raises(InputError, match=r"pixel aspect is 12; 0\.25 to 4 is expected"):
        read_frames(path, pixel_aspect=12)


# --- geometry of pixels -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("rotation", [0, 90, 180, 270])
@pytest.mark.parametrize("mirrored", [False, True])
def test_images_are_turned_and_mirrored_once(tmp_path, rotation, mirrored):
    image = moving_texture(1)[0]
    path = write_video(
        tmp_path / "shot.mov", [image] * 2, "mpeg4", rotation=rotation, mirrored=mirrored, aspect=Fraction(4, 3)
    )
    shown = np.rot90(image, rotation // 90)
    shown = shown[:, ::-1] if mirrored else shown
    frame = next(read_frames(path))
    assert frame.image.shape == shown.shape
    assert np.abs(grey(frame.image) - grey(shown)).mean() < 3.0
    assert frame.pixel_aspect == pytest.approx(3 / 4 if rotation % 180 else 4 / 3)


def test_pixel_aspect_of_the_container_and_of_the_user(tmp_path):
    path = write_video(tmp_path / "shot.mp4", moving_texture(2), aspect=Fraction(2))
    assert next(read_frames(path)).pixel_aspect == 2.0
    assert next(read_frames(path, pixel_aspect=1.5)).pixel_aspect == 1.5
    assert next(read_frames(path, pixel_aspect=1.5, fields="apart")).pixel_aspect == 0.75


@pytest.mark.parametrize("aspect", [Fraction(1, 100), Fraction(9, 2)])
def test_a_pixel_aspect_that_no_footage_has_is_ignored(tmp_path, caplog, aspect):
    path = write_video(tmp_path / "shot.mkv", moving_texture(2), aspect=aspect)
    assert {frame.pixel_aspect for frame in read_frames(path)} == {1.0}
    said = f"states a pixel aspect of {float(aspect):g}, which is ignored; 0.25 to 4 is expected"
    assert said in caplog.text


# --- colour -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("color_range", [LIMITED, FULL])
def test_limited_and_full_range_show_the_same(tmp_path, color_range):
    ramp = np.repeat(np.tile(np.linspace(0, 255, 320).astype(np.uint8), (240, 1))[:, :, None], 3, axis=2)
    path = write_video(tmp_path / "shot.mkv", [ramp] * 2, "ffv1", "yuv444p", color_range=color_range, colorspace=BT709)
    assert np.abs(grey(next(read_frames(path)).image) - grey(ramp)).max() < 3.0


def test_the_matrix_is_that_which_the_file_states(tmp_path):
    red = np.zeros((64, 64, 3), np.uint8)
    red[:] = (20, 40, 220)
    path = write_video(tmp_path / "shot.mp4", [red] * 3, options={"crf": "4"}, colorspace=BT709, color_range=LIMITED)
    assert np.abs(next(read_frames(path)).image.reshape(-1, 3).mean(axis=0) - (20, 40, 220)).max() < 4.0


def pq(nits: float) -> float:
    """Signal of PQ (SMPTE ST 2084)."""
    y = (nits / 10000) ** 0.1593017578125
    return ((0.8359375 + 18.8515625 * y) / (1 + 18.6875 * y)) ** 78.84375


def hlg(light: float) -> float:
    """Signal of HLG (ITU-R BT.2100) for light of the scene, 1 at most."""
    return (3 * light) ** 0.5 if light <= 1 / 12 else 0.17883277 * np.log(12 * light - 0.28466892) + 0.55991073


@pytest.mark.parametrize(
    ("transfer", "signals"),
    [(PQ, [pq(203 * f) for f in (0.05, 0.2, 1.0, 4.9)]), (HLG, [hlg(0.265 * f) for f in (0.05, 0.2, 1.0, 3.7)])],
)
def test_high_dynamic_range_gets_one_tone_curve(tmp_path, transfer, signals):
    """Reinhard's curve of the light over diffuse white, x (1 + x / w^2) / (1 + x) with w = 1000 / 203, as sRGB."""
    image = np.zeros((64, 256, 3), np.uint16)
    for k, signal in enumerate(signals):
        image[:, 64 * k : 64 * (k + 1)] = round(65535 * signal)
    path = write_video(tmp_path / "shot.mkv", [image] * 2, "ffv1", "yuv444p16le", color_trc=transfer, colorspace=BT2020)
    found = next(read_frames(path)).image[32, 32::64].mean(axis=1)
    light = np.array([0.05, 0.2, 1.0, 4.9 if transfer == PQ else 3.7])
    shown = light * (1 + light * (203 / 1000) ** 2) / (1 + light)
    assert found == pytest.approx(255 * (1.055 * shown ** (1 / 2.4) - 0.055), abs=2.5)


def test_ten_bits_without_tags_are_shown_as_they_are(tmp_path):
    ramp = np.repeat(np.tile(np.linspace(0, 65535, 320).astype(np.uint16), (64, 1))[:, :, None], 3, axis=2)
    path = write_video(tmp_path / "shot.mkv", [ramp] * 2, "ffv1", "yuv444p10le")
    assert np.abs(grey(next(read_frames(path)).image) - grey(ramp) / 257).max() < 3.0
