"""Video files as they come: codecs, containers, times, fields, pixel aspect, orientation and colour."""

import re
from fractions import Fraction
from pathlib import Path

import av
import cv2
import numpy as np
import pytest
from av.stream import Disposition

from factorsfm.frames.ranges import parse_range
from factorsfm.frames.reading import read_frames
from factorsfm.support.errors import InputError
from factorsfm.synthetic import render_shot
from tests.video_files import (
    BT709,
    BT2020,
    FORMATS,
    FULL,
    HLG,
    LIMITED,
    PQ,
    QUIET_H265,
    interlaced,
    marked_as_sphere,
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
    for _ in range(2):  # of each file, though FFmpeg says it once
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


@pytest.mark.parametrize("name", ["notes.txt", "shot.nfo", "notes.mov"])
def test_text_is_refused(tmp_path, name):
    (tmp_path / name).write_text("Shot notes: take 3, 35 mm, T2.8\n" * 50)
    with pytest.raises(InputError, match=r"cannot be decoded as a video"):
        read_frames(tmp_path / name)


def test_an_image_of_another_kind_is_refused(tmp_path):
    cv2.imwrite(str(tmp_path / "shot.jp2"), moving_texture(1)[0])
    with pytest.raises(InputError, match=r"shot\.jp2 is a single image; a video file or a folder of images"):
        read_frames(tmp_path / "shot.jp2")


def with_streams(path: Path, streams: list[tuple[list[np.ndarray], str, Disposition]], *, sound: bool = False) -> Path:
    """A file of several videos, one behind the other: images, codec and disposition of each."""
    with av.open(str(path), "w") as container:
        added = [container.add_stream("aac", rate=48000)] if sound else []
        for images, codec, disposition in streams:
            stream = container.add_stream(codec, rate=25)
            stream.height, stream.width = images[0].shape[:2]
            stream.pix_fmt = "yuvj420p" if codec == "mjpeg" else "yuv420p"
            stream.disposition = disposition
            added.append(stream)
        if sound:
            silence = av.AudioFrame.from_ndarray(np.zeros((2, 1024), np.float32), format="fltp", layout="stereo")
            silence.sample_rate = 48000
            container.mux([*added[0].encode(silence), *added[0].encode(None)])
        for stream, (images, _, _) in zip(added[-len(streams) :], streams, strict=True):
            for image in images:
                container.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="bgr24")))
            container.mux(stream.encode(None))
    return path


def test_sound_with_a_cover_is_refused(tmp_path):
    cover = (moving_texture(1), "mjpeg", Disposition.attached_pic)
    path = with_streams(tmp_path / "song.mp4", [cover], sound=True)
    with pytest.raises(InputError, match=r"song\.mp4 .* holds no picture"):
        read_frames(path)


def test_the_best_of_several_videos_is_read_and_named(tmp_path, caplog):
    proxy = (moving_texture(12, size=(160, 120)), "libx264", Disposition(0))
    whole = (moving_texture(12), "libx264", Disposition.default)
    path = with_streams(tmp_path / "shot.mkv", [proxy, whole])
    assert [frame.image.shape for frame in read_frames(path)] == [(240, 320, 3)] * 12
    assert caplog.messages == [f"{path} holds 2 videos; stream 1 is used, of 320x240 pixels"]


def test_a_cover_in_front_of_a_video_is_not_read(tmp_path, caplog):
    cover = (moving_texture(1, size=(160, 120)), "mjpeg", Disposition.attached_pic)
    path = with_streams(tmp_path / "shot.mp4", [cover, (moving_texture(12), "libx264", Disposition.default)])
    assert [frame.image.shape for frame in read_frames(path)] == [(240, 320, 3)] * 12
    assert not caplog.messages


def test_damage_inside_a_file_says_nothing_on_standard_error(tmp_path, capfd):
    path = write_video(tmp_path / "shot.mp4", moving_texture(40))
    data = bytearray(path.read_bytes())
    data[len(data) // 2 : len(data) // 2 + 200] = bytes(200)
    path.write_bytes(data)
    assert 10 < len(list(read_frames(path))) <= 40
    assert capfd.readouterr().err == ""


def with_broken_packet(path: Path, number: int) -> Path:
    """The same file with zeros in the middle of a packet."""
    with av.open(str(path)) as container:
        packets = [(packet.pos, packet.size) for packet in container.demux(video=0) if packet.size]
    position, size = packets[number]
    data = bytearray(path.read_bytes())
    data[position + size // 3 : position + 2 * (size // 3)] = bytes(size // 3)
    path.write_bytes(data)
    return path


def test_a_frame_that_is_broken_leaves_its_number_free(tmp_path, caplog):
    images = moving_texture(40)
    options = {"g": "1", "x264-params": "keyint=1"}
    path = with_broken_packet(write_video(tmp_path / "shot.mp4", images, options=options), 20)
    frames = list(read_frames(path))
    assert [frame.index for frame in frames] == [*range(20), *range(21, 40)]
    for frame in frames:
        assert frame.timestamp == pytest.approx(frame.index / 25, abs=1e-3)
        assert np.abs(grey(frame.image) - grey(images[frame.index])).mean() < 3.0
    assert caplog.messages == [f"{path} is damaged; frames that cannot be read: 1 (20); the others keep their numbers"]
    assert [frame.index for frame in read_frames(path, slice(18, 24))] == [18, 19, 21, 22, 23]


def test_a_hole_in_a_stream_leaves_numbers_free_and_corrupt_frames_out(tmp_path, caplog):
    images = moving_texture(130, size=(160, 120))
    path = write_video(tmp_path / "shot.ts", images, options={"g": "12"})
    data = bytearray(path.read_bytes())
    middle = len(data) // 2 // 188 * 188
    data[middle : middle + 30 * 188] = bytes(30 * 188)
    path.write_bytes(data)
    frames = list(read_frames(path))
    missing = sorted(set(range(130)) - {frame.index for frame in frames})
    assert 1 < len(missing) < 40
    assert frames[-1].index == 129
    assert [frame.timestamp for frame in frames] == pytest.approx([frame.index / 25 for frame in frames], abs=1e-3)
    for frame in frames[-40:]:  # behind the next keyframe
        assert np.abs(grey(frame.image) - grey(images[frame.index])).mean() < 4.0
    assert f"frames that cannot be read: {len(missing)} ({missing[0]}, " in caplog.text
    late = list(read_frames(path, slice(120, None)))
    assert [frame.index for frame in late] == list(range(120, 130))


@pytest.mark.parametrize(
    ("stereo", "said"),
    [("left_right", "side by side"), ("bottom_top", "one above the other"), ("col_interleaved_lr", "in columns")],
)
def test_two_views_in_a_frame_are_refused_and_one_is_read(tmp_path, stereo, said):
    with pytest.raises(InputError, match=rf"shot\.mkv holds two views in each frame \({said}\); cut one of them out"):
        read_frames(write_video(tmp_path / "shot.mkv", moving_texture(3), stereo=stereo))
    assert len(list(read_frames(write_video(tmp_path / "shot.mkv", moving_texture(3), stereo="mono")))) == 3


def test_a_video_of_a_sphere_is_refused(tmp_path):
    path = write_video(tmp_path / "shot.mp4", moving_texture(3))
    assert len(list(read_frames(path))) == 3
    with pytest.raises(InputError, match=r"shot\.mp4 is a 360 degree video \(equirectangular\), .*make a flat view"):
        read_frames(marked_as_sphere(path))


def test_damage_that_a_decoder_does_not_report_is_seen_in_the_images(tmp_path, caplog):
    """H.265 decodes blocks of noise from zeros, and says nothing; noise that was filmed is no damage."""
    images = render_shot("truck", 30, 320, 180, parallax=0.06).images
    path = write_video(tmp_path / "shot.mkv", images, "libx265", options=QUIET_H265)
    whole = path.read_bytes()
    assert len(list(read_frames(path))) == 30
    noise = np.random.default_rng(0).integers(0, 255, (10, 180, 320, 3), dtype=np.uint8)
    assert len(list(read_frames(write_video(tmp_path / "noise.mp4", noise)))) == 10
    assert caplog.messages == []
    begin, end = len(whole) // 4, len(whole) * 9 // 10
    damaged = bytearray(whole)
    for hole in range(begin, end, (end - begin) // 8):
        damaged[hole : hole + 100] = bytes(100)
    path.write_bytes(damaged)
    assert len(list(read_frames(path))) == 30
    (said,) = caplog.messages
    found = re.search(r"shot\.mkv may be damaged: (\d+) frames \(.*\) have many times the edges of the keyframe", said)
    assert found is not None
    assert 5 <= int(found[1]) <= 25


def test_uneven_frames_are_counted_one_by_one_beside_damage(tmp_path):
    times = [0, 4, 8, 12, 20, 28, *range(36, 76, 4)]
    path = write_video(tmp_path / "shot.mkv", moving_texture(16), times=times, options={"x264-params": "keyint=1"})
    assert [frame.index for frame in read_frames(with_broken_packet(path, 8))] == list(range(15))


def test_a_file_that_was_cut_off_says_how_much_of_it_is_missing(tmp_path, caplog):
    path = write_video(tmp_path / "shot.mkv", moving_texture(60), options={"g": "5"})
    assert len(list(read_frames(path))) == 60
    assert not caplog.messages
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    read = len(list(read_frames(path)))
    assert f"shot.mkv: only {read / 25:.1f} of the 2.4 seconds that the container announces" in caplog.text


def test_all_frames_before_the_cut_of_a_file_are_read(tmp_path):
    path = tmp_path / "shot.mp4"
    write_video(tmp_path / "whole.mp4", moving_texture(40))
    remux(tmp_path / "whole.mp4", path, {"movflags": "faststart"})
    with av.open(str(path)) as container:
        packets = [packet for packet in container.demux(video=0) if packet.size]
    path.write_bytes(path.read_bytes()[: packets[25].pos + packets[25].size // 2])
    with av.open(str(path)) as container:
        container.streams.video[0].thread_type = "NONE"
        expected = sum(len(p.decode()) for p in container.demux(video=0) if not p.is_corrupt)
    assert len(list(read_frames(path))) == expected


def remux(source: Path, target: Path, options: dict[str, str]) -> None:
    with av.open(str(source)) as old, av.open(str(target), "w", options=options) as new:
        stream = new.add_stream_from_template(old.streams.video[0])
        for packet in old.demux(video=0):
            if packet.size:
                packet.stream = stream
                new.mux(packet)


def test_uneven_times_are_kept(tmp_path):
    times = [0, 4, 8, 12, 20, 28, 36]
    path = write_video(tmp_path / "shot.mkv", moving_texture(7), **LOSSLESS, times=times)
    assert [frame.timestamp for frame in read_frames(path)] == pytest.approx(np.array(times) / 100, abs=1e-3)


@pytest.mark.parametrize(("suffix", "codec"), [(".ts", "libx264"), (".mpg", "mpeg2video"), (".avi", "mpeg4")])
def test_a_late_range_holds_the_frames_that_it_names(tmp_path, suffix, codec):
    """These containers have no index of their keyframes, and a jump lands behind the one that is needed."""
    options = {"g": "50", "bf": "2"}
    path = write_video(tmp_path / f"shot{suffix}", moving_texture(130, size=(160, 120)), codec, options=options)
    everything = list(read_frames(path))
    for start in (100, 107, 119, 127):
        late = list(read_frames(path, slice(start, None)))
        assert [frame.index for frame in late] == list(range(start, len(everything)))
        for frame, same in zip(late, everything[start:], strict=True):
            assert frame.timestamp == same.timestamp
            np.testing.assert_array_equal(frame.image, same.image)


def test_a_late_range_that_no_jump_finds_is_decoded_from_the_start(tmp_path, monkeypatch):
    path = write_video(tmp_path / "shot.mkv", moving_texture(110, size=(160, 120)))
    monkeypatch.setattr("factorsfm.frames.video._LEADS", ())
    assert [frame.index for frame in read_frames(path, slice(104, 107))] == [104, 105, 106]


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

    def fail(*_: object) -> None:
        raise av.error.OSError(5, "Input/output error")

    monkeypatch.setattr("factorsfm.frames.container._packet_frames", fail)
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


def detailed(count: int, step: float) -> list[np.ndarray]:
    """Moving texture that differs strongly from line to line, and a still half with grain."""
    rng = np.random.default_rng(1)
    lines = rng.normal(0.0, 25.0, (240, 1, 1))
    images = []
    for image in moving_texture(count, step):
        image = 0.6 * image.astype(np.float64) + 50 + lines
        image[:, 160:] = image[:, :1]
        images.append(np.clip(image + rng.normal(0.0, 2.0, (240, 320, 1)), 0, 255).astype(np.uint8))
    return images


@pytest.mark.parametrize("top_first", [True, False])
@pytest.mark.parametrize("codec", ["libx264", "mpeg2video"])
@pytest.mark.parametrize("step", [1.0, 7.0])
def test_vertical_detail_is_no_second_moment(tmp_path, codec, top_first, step):
    """The lines of two fields differ by the detail of the picture, which outweighs slow motion."""
    film = [image for image in detailed(26, step) for _ in range(2)]
    stored = interlaced(tmp_path / "film.mkv", film, codec, top_first=top_first)
    assert next(read_frames(stored)).image.shape == (240, 320, 3)
    video = interlaced(tmp_path / "video.mkv", detailed(52, step / 2), codec, top_first=top_first)
    assert next(read_frames(video)).image.shape == (120, 320, 3)


def test_where_nothing_moves_the_flags_count(tmp_path):
    path = interlaced(tmp_path / "shot.mkv", detailed(52, 0.0), top_first=True)
    assert next(read_frames(path)).image.shape == (120, 320, 3)


def test_film_whose_fields_are_spread_over_video_frames_is_taken_apart(tmp_path):
    """24 in 30 frames a second by fields: two of five frames hold fields of two images."""
    film = detailed(20, 4.0)
    fields = [image for k, image in enumerate(film) for _ in range(2 + k % 2)]
    path = interlaced(tmp_path / "shot.mkv", fields, top_first=True)
    assert next(read_frames(path)).image.shape == (120, 320, 3)


def joined(tmp_path, whole: list[np.ndarray], moments: list[np.ndarray]) -> Path:
    """A video of whole frames that becomes interlaced."""
    first = write_video(tmp_path / "first.ts", whole)
    path = interlaced(tmp_path / "shot.ts", moments)
    path.write_bytes(first.read_bytes() + path.read_bytes())
    return path


@pytest.mark.parametrize("before", [10, 40])
def test_frames_that_become_interlaced_later_are_not_tracked_combed(tmp_path, before):
    moments = detailed(2 * before + 40, 2.0)
    path = joined(tmp_path, moments[: 2 * before : 2], moments[2 * before :])
    with pytest.raises(
        InputError, match=rf"shot\.ts is interlaced before frame {before + 4}, but not at its beginning"
    ):
        list(read_frames(path))
    assert len(list(read_frames(path, slice(0, before)))) == before
    assert len(list(read_frames(path, fields="apart"))) == len(moments)
    assert len(list(read_frames(path, fields="blend"))) == len(moments) // 2


def test_frames_of_one_moment_that_are_flagged_late_stay_whole(tmp_path):
    film = detailed(60, 2.0)
    path = joined(tmp_path, film[:40], [image for image in film[40:] for _ in range(2)])
    assert len(list(read_frames(path))) == 60


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
