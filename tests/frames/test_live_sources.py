import gc
import io
import itertools
import logging
import os
import socket
import threading
import time
from contextlib import contextmanager
from pathlib import Path

import cv2
import numpy as np
import pytest

from factorsfm.frames.frame import Frame
from factorsfm.frames.live_sources import open_source
from factorsfm.frames.raw import RawFormat
from factorsfm.support.errors import InputError

WIDTH, HEIGHT = 64, 48


def image(value: int) -> np.ndarray:
    return np.full((HEIGHT, WIDTH, 3), value, np.uint8)


def values(frames: list[Frame]) -> list[int]:
    return [round(float(frame.image.mean())) for frame in frames]


def encoded(value: int, suffix: str) -> bytes:
    noise = np.random.default_rng(value).integers(0, 9, (HEIGHT, WIDTH, 3), dtype=np.uint8)
    return cv2.imencode(suffix, image(value) + noise)[1].tobytes()


@pytest.fixture(autouse=True)
def no_thread_stays():
    before = set(threading.enumerate())
    yield
    deadline = time.monotonic() + 2.0
    while (left := set(threading.enumerate()) - before) and time.monotonic() < deadline:
        gc.collect()
        time.sleep(0.01)
    assert not left


@pytest.fixture(scope="module")
def video(tmp_path_factory) -> Path:
    """Twelve grey frames whose brightness is 20 times their number; every frame is a JPEG of its own."""
    path = tmp_path_factory.mktemp("video") / "shot.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 25, (WIDTH, HEIGHT))
    for index in range(12):
        writer.write(image(20 * index))
    writer.release()
    return path


@contextmanager
def pipe():
    reading, writing = os.pipe()
    with os.fdopen(reading, "rb") as reader, os.fdopen(writing, "wb", buffering=0) as writer:
        yield reader, writer


# --- files and iterables ------------------------------------------------------------------------------------------


def test_a_video_is_read_to_its_end(video):
    with open_source(video) as source:
        frames = list(source)
    assert [frame.index for frame in frames] == list(range(12))
    assert values(frames) == pytest.approx([20 * k for k in range(12)], abs=3)
    assert frames[3].timestamp == pytest.approx(0.12)
    assert all(frame.dropped == 0 for frame in frames)
    assert source.ended == f"{video} ended after 12 frames"
    assert not source.broke_off
    assert next(source, None) is None


def test_a_range_of_every_kind_of_source(video, tmp_path):
    for index in range(12):
        cv2.imwrite(str(tmp_path / f"{index}.png"), image(20 * index))
    (tmp_path / "end").touch()
    raw = io.BytesIO(b"".join(image(20 * index).tobytes() for index in range(12)))
    sources = [
        open_source(video, frames=slice(2, 9, 3)),
        open_source(tmp_path, frames=slice(2, 9, 3)),
        open_source(tmp_path, frames=slice(2, 9, 3), watch=True, end_file="end"),
        open_source(raw, raw=RawFormat(WIDTH, HEIGHT), frames=slice(2, 9, 3)),
        open_source((image(20 * index) for index in range(12)), frames=slice(2, 9, 3)),
    ]
    for source in sources:
        frames = list(source)
        assert [frame.index for frame in frames] == [2, 5, 8]
        assert values(frames) == pytest.approx([40, 100, 160], abs=3)


def test_no_more_is_read_than_the_range_needs():
    taken = itertools.count()
    assert len(list(open_source((image(next(taken)) for _ in itertools.count()), frames=slice(2, 6)))) == 4
    assert next(taken) == 6


@pytest.mark.parametrize(
    ("source", "arguments", "reason"),
    [
        ("nowhere.mp4", {}, "nowhere.mp4 does not exist"),
        (np.zeros((4, 4), np.uint8), {}, "single image"),
        (None, {}, "NoneType"),
        (True, {}, "bool"),
        ([], {"queue_size": 0}, "queue_size is 0"),
        ([], {"stall_seconds": 0.0}, "stall_seconds 0.0"),
        ([], {"frames": slice(5, 5)}, "empty"),
        ([], {"raw": RawFormat(4, 4)}, "no stream of raw frames"),
        ([], {"end_file": "end"}, "unless a folder is watched"),
        ("nowhere", {"watch": True}, "nowhere cannot be watched"),
        ("-", {}, "standard input holds raw frames"),
        (io.BytesIO(), {}, "size and pixel format"),
        (io.StringIO(), {"raw": RawFormat(4, 4)}, "opened as text"),
        ("camera:front", {}, "camera:0 is the first"),
        (99, {}, "camera 99 cannot be opened"),
        ("camera:99", {}, "camera 99 cannot be opened"),
        (-5, {}, "-5 is no camera"),
        ("http://me:secret@127.0.0.1:9/a?key=secret", {}, r"^http://127.0.0.1:9/a cannot be opened$"),
    ],
)
def test_an_impossible_source_is_refused_at_the_call(source, arguments, reason, capfd):
    with pytest.raises(InputError, match=reason):
        open_source(source, **arguments)
    assert capfd.readouterr().err == ""


@pytest.mark.parametrize(
    ("source", "arguments", "reason"),
    [
        ([], {}, "holds no frames"),
        (["text"], {}, "frame 0 is of type str"),
        ((1 / 0 for _ in range(3)), {}, "failed: ZeroDivisionError"),
        (io.BytesIO(), {"raw": RawFormat(4, 4)}, "the raw stream holds no frames"),
        (io.BytesIO(b"abc"), {"raw": RawFormat(4, 4)}, "ended inside frame 0: 3 of 48 bytes"),
    ],
)
def test_a_source_without_a_first_frame_is_an_error(source, arguments, reason):
    opened = open_source(source, **arguments)
    with pytest.raises(InputError, match=reason):
        next(opened)
    assert next(opened, None) is None


@pytest.mark.parametrize(
    ("bad", "reason"), [("text", "frame 3 is of type str"), (np.zeros((5, 5), np.uint8), "5x5 pixels")]
)
def test_what_breaks_off_later_ends_cleanly(bad, reason, caplog):
    source = open_source([image(0), image(1), image(2), bad, image(4)])
    assert values(list(source)) == [0, 1, 2]
    assert source.broke_off
    assert source.ended.startswith("broken off after 3 frames: ")
    assert reason in source.ended
    assert [(record.levelno, record.message) for record in caplog.records] == [(logging.WARNING, source.ended)]


def test_foreign_errors_end_the_source_too():
    def failing():
        yield image(0)
        raise OSError("cable pulled")

    source = open_source(failing())
    assert len(list(source)) == 1
    assert source.ended == "broken off after 1 frames: the sequence of images failed: OSError('cable pulled')"


# --- the queue ----------------------------------------------------------------------------------------------------


def test_frames_wait_in_a_bounded_queue():
    read: list[int] = []

    def counted():
        for index in range(20):
            read.append(index)
            yield image(index)

    with open_source(counted(), queue_size=3) as source:
        assert next(source).index == 0
        time.sleep(0.1)
        assert len(read) == 5  # one consumed, three waiting, one in the hand of the thread
        assert [frame.index for frame in source] == list(range(1, 20))
        assert source.dropped == 0


def test_a_slow_consumer_of_a_live_source_loses_the_oldest_and_is_told():
    def live():
        for index in range(60):
            time.sleep(0.002)
            yield image(index)

    frames = []
    with open_source(live(), drop=True, queue_size=2) as source:
        for frame in source:
            frames.append(frame)
            time.sleep(0.012)
    assert 5 < len(frames) < 40
    assert source.dropped == sum(frame.dropped for frame in frames) == 60 - len(frames)
    positions = np.cumsum([frame.dropped + 1 for frame in frames]) - 1
    assert [frame.index for frame in frames] == positions.tolist()
    assert frames[-1].index == 59
    assert f"ended after 60 frames, {source.dropped} of them dropped" in source.ended


def test_a_fast_consumer_of_a_live_source_loses_nothing():
    def live():
        for index in range(10):
            time.sleep(0.005)
            yield image(index)

    assert [frame.dropped for frame in open_source(live(), drop=True)] == [0] * 10


# --- stopping early -----------------------------------------------------------------------------------------------


def endless():
    try:
        for index in itertools.count():
            yield image(index % 256)
    finally:
        released.set()


released = threading.Event()


@pytest.mark.parametrize("drop", [False, True])
@pytest.mark.parametrize("error", [None, KeyboardInterrupt, ValueError])
def test_leaving_early_stops_the_thread_and_releases_the_source(drop, error):
    released.clear()
    start = time.monotonic()

    def consume():
        with open_source(endless(), drop=drop) as source:
            opened.append(source)
            for frame in source:
                if frame.index > 5:
                    if error:
                        raise error
                    break

    opened = []
    if error:
        with pytest.raises(error):
            consume()
    else:
        consume()
    (source,) = opened
    assert time.monotonic() - start < 1.0
    assert not source._thread.is_alive()
    assert released.is_set()
    assert "was closed after" in source.ended
    assert not source.broke_off
    assert next(source, None) is None
    source.close()


def test_a_forgotten_source_stops_as_well():
    released.clear()
    for frame in open_source(endless()):
        if frame.index == 3:
            break
    gc.collect()
    assert released.wait(1.0)


def test_closing_from_another_thread_wakes_a_waiting_consumer():
    with pipe() as (reader, _):
        source = open_source(reader, raw=RawFormat(WIDTH, HEIGHT), stall_seconds=None)
        threading.Timer(0.1, source.close).start()
        assert next(source, None) is None
        assert source.ended == "the raw stream was closed after 0 frames"


def test_a_source_that_was_never_read_is_released():
    released.clear()
    open_source(endless()).close()
    assert released.is_set()


# --- stalls -------------------------------------------------------------------------------------------------------


def test_a_stalled_source_ends_with_what_it_gave():
    resume = threading.Event()

    def stalling():
        yield image(1)
        yield image(2)
        resume.wait(10.0)

    source = open_source(stalling(), stall_seconds=0.15)
    start = time.monotonic()
    threading.Timer(0.5, resume.set).start()
    assert values(list(source)) == [1, 2]
    assert 0.15 <= time.monotonic() - start < 1.5
    assert source.broke_off
    assert source.ended == "broken off after 2 frames: the sequence of images gave no frame for 0.15 s"


def test_a_source_that_never_begins_is_an_error(tmp_path):
    source = open_source(tmp_path, watch=True, stall_seconds=0.15)
    with pytest.raises(InputError, match=r"gave no frame for 0\.15 s"):
        next(source)


# --- raw frames ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("pixels", ["bgr24", "rgb24", "gray8", "yuv420p", "nv12"])
def test_raw_frames_of_every_format(pixels):
    smooth = np.stack(np.meshgrid(np.linspace(60, 190, WIDTH), np.linspace(60, 190, HEIGHT)), -1)
    bgr = np.dstack([smooth, smooth.mean(-1)]).astype(np.uint8)
    if pixels == "gray8":
        bgr = np.repeat(bgr[:, :, :1], 3, axis=2)
    yuv = cv2.cvtColor(bgr, cv2.COLOR_BGR2YUV_I420)
    chroma = yuv[HEIGHT:].reshape(2, -1)
    data = {
        "bgr24": bgr,
        "rgb24": bgr[:, :, ::-1],
        "gray8": bgr[:, :, 0],
        "yuv420p": yuv,
        "nv12": np.concatenate([yuv[:HEIGHT].ravel(), chroma.T.ravel()]),
    }[pixels].tobytes()
    raw = RawFormat(WIDTH, HEIGHT, pixels)
    assert raw.frame_bytes == len(data)
    frames = list(open_source(io.BytesIO(2 * data), raw=raw))
    assert [(frame.index, frame.name) for frame in frames] == [(0, "000000"), (1, "000001")]
    for frame in frames:
        assert frame.image.shape == (HEIGHT, WIDTH, 3)
        np.testing.assert_allclose(frame.image.astype(int), bgr, atol=4 if pixels in ("yuv420p", "nv12") else 0)


def test_parse_raw_format():
    assert RawFormat.parse("960x540:yuv420p") == RawFormat(960, 540, "yuv420p")


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("960x540", "WIDTHxHEIGHT:PIXELS"),
        ("axb:bgr24", "WIDTHxHEIGHT:PIXELS"),
        ("-3x4:bgr24", "WIDTHxHEIGHT:PIXELS"),
        ("960x540:rgb48", '"rgb48" is not one of bgr24, rgb24'),
        ("0x4:bgr24", "0x4 pixels hold nothing"),
        ("5x4:nv12", "nv12 needs even numbers"),
        ("4x5:yuv420p", "yuv420p needs even numbers"),
    ],
)
def test_bad_raw_format_is_refused(text, reason):
    with pytest.raises(InputError, match=reason):
        RawFormat.parse(text)


def test_a_raw_stream_that_breaks_off_inside_a_frame():
    with pipe() as (reader, writer):

        def write():
            data = b"".join(image(value).tobytes() for value in (10, 20, 30))
            for begin in range(0, len(data) - 1000, 700):  # never a whole frame at once
                writer.write(data[begin : min(begin + 700, len(data) - 1000)])
            writer.close()

        thread = threading.Thread(target=write)
        thread.start()
        source = open_source(reader, raw=RawFormat(WIDTH, HEIGHT))
        assert values(list(source)) == [10, 20]
        thread.join()
    assert source.broke_off
    assert source.ended == "broken off after 2 frames: the raw stream ended inside frame 2: 8216 of 9216 bytes"


def test_a_raw_stream_that_ends_between_frames(monkeypatch):
    with pipe() as (reader, writer):
        writer.write(image(10).tobytes())
        writer.write(image(20).tobytes())
        writer.close()
        monkeypatch.setattr("sys.stdin", io.TextIOWrapper(reader))
        source = open_source("-", raw=RawFormat(WIDTH, HEIGHT))
        assert values(list(source)) == [10, 20]
    assert source.ended == "standard input ended after 2 frames"
    assert not source.broke_off


@pytest.mark.parametrize("rest", [b"", b"begin of a frame"])
def test_a_silent_pipe_neither_hangs_nor_keeps_the_thread(rest):
    with pipe() as (reader, writer):
        writer.write(image(10).tobytes() + rest)
        source = open_source(reader, raw=RawFormat(WIDTH, HEIGHT), stall_seconds=0.2)
        assert values(list(source)) == [10]
        assert "gave no frame for 0.2 s" in source.ended
        assert not source._thread.is_alive()


def test_a_silent_pipe_is_left_at_once():
    with pipe() as (reader, writer):
        writer.write(image(10).tobytes())
        with open_source(reader, raw=RawFormat(WIDTH, HEIGHT)) as source:
            next(source)
        assert not source._thread.is_alive()


# --- a folder that is being filled --------------------------------------------------------------------------------


@pytest.mark.parametrize("suffix", [".png", ".jpg"])
def test_a_folder_filled_while_it_is_read(tmp_path, suffix, caplog):
    for value in (8, 9):
        (tmp_path / f"img{value}{suffix}").write_bytes(encoded(10 * value, suffix))

    def fill():
        for value in (10, 11, 12):
            data = encoded(10 * value, suffix)
            with open(tmp_path / f"img{value}{suffix}", "wb") as file:
                for part in (data[:1], data[1 : len(data) // 2], data[len(data) // 2 :]):  # slower than a look
                    file.write(part)
                    file.flush()
                    time.sleep(0.13)
        (tmp_path / "notes.txt").write_text("no image")
        (tmp_path / "end").touch()

    thread = threading.Thread(target=fill)
    thread.start()
    source = open_source(tmp_path, watch=True, end_file="end", stall_seconds=5.0)
    frames = list(source)
    thread.join()
    assert [frame.name for frame in frames] == [f"img{value}{suffix}" for value in (8, 9, 10, 11, 12)]
    assert [frame.index for frame in frames] == [8, 9, 10, 11, 12]
    for frame, value in zip(frames, (8, 9, 10, 11, 12), strict=True):
        np.testing.assert_array_equal(
            frame.image, cv2.imdecode(np.frombuffer(encoded(10 * value, suffix), np.uint8), cv2.IMREAD_COLOR)
        )
    assert source.ended == f"folder {tmp_path} ended after 5 frames"
    assert caplog.records == []


def test_a_folder_that_is_filled_no_further_ends(tmp_path):
    (tmp_path / "1.png").write_bytes(encoded(10, ".png"))
    source = open_source(tmp_path, watch=True, stall_seconds=2.0)
    assert [frame.name for frame in source] == ["1.png"]
    assert "gave no frame for 2 s" in source.ended


def test_damaged_and_late_images_are_left_out(tmp_path, monkeypatch, caplog):
    monkeypatch.setattr("factorsfm.frames.watched_folder._PATIENCE_SECONDS", 0.25)
    for value in (2, 4, 5):
        (tmp_path / f"{value}.jpg").write_bytes(encoded(10 * value, ".jpg"))
    (tmp_path / "4.jpg").write_bytes(encoded(40, ".jpg")[:-200])
    source = open_source(tmp_path, watch=True, end_file="end", stall_seconds=5.0)
    assert [next(source).name for _ in range(2)] == ["2.jpg", "5.jpg"]
    (tmp_path / "3.jpg").write_bytes(encoded(30, ".jpg"))
    (tmp_path / "6.jpg").write_bytes(encoded(60, ".jpg"))
    assert next(source).name == "6.jpg"
    (tmp_path / "end").touch()
    assert next(source, None) is None
    assert [record.message for record in caplog.records] == [
        f"image {tmp_path / '4.jpg'} is left out: it is damaged",
        f"image {tmp_path / '3.jpg'} is left out: it appeared after 5.jpg",
    ]


def test_damaged_images_of_a_folder_are_left_out(tmp_path, caplog):
    for value in range(6):
        (tmp_path / f"{value}.png").write_bytes(encoded(10 * value, ".png")[: -20 if value in (0, 3) else None])
    source = open_source(tmp_path, frames=slice(0, 5))
    assert [(frame.index, frame.name) for frame in source] == [(1, "1.png"), (2, "2.png"), (4, "4.png")]
    assert not source.broke_off
    assert [record.message for record in caplog.records] == [
        f"image {name} is left out: it is truncated" for name in ("0.png", "3.png")
    ]


def test_an_image_of_another_size_ends_a_watched_folder(tmp_path):
    cv2.imwrite(str(tmp_path / "1.png"), image(1))
    cv2.imwrite(str(tmp_path / "2.png"), image(2)[:20])
    source = open_source(tmp_path, watch=True)
    assert [frame.name for frame in source] == ["1.png"]
    assert "2.png" in source.ended
    assert "64x20" in source.ended


# --- cameras and networks -----------------------------------------------------------------------------------------


class Camera:
    """Ten frames, then it is unplugged."""

    def __init__(self, number: int) -> None:
        self.number = number
        self.read_frames = 0
        self.released = False
        cameras.append(self)

    def isOpened(self) -> bool:
        return True

    def read(self) -> tuple[bool, np.ndarray | None]:
        self.read_frames += 1
        time.sleep(0.01)
        return (True, image(self.read_frames)) if self.read_frames <= 10 else (False, None)

    def release(self) -> None:
        self.released = True


cameras: list[Camera] = []


@pytest.mark.parametrize("source", [2, "camera:2"])
def test_a_camera_that_is_unplugged(source, monkeypatch):
    monkeypatch.setattr(cv2, "VideoCapture", Camera)
    opened = open_source(source)
    frames = list(opened)
    assert values(frames) == list(range(1, 11))
    assert cameras[-1].number == 2
    assert cameras[-1].released
    assert frames[0].timestamp == 0.0
    assert 0.09 <= frames[-1].timestamp < 1.0
    assert opened.ended == "broken off after 10 frames: camera 2 gives no further frame"


def test_a_camera_drops_what_nobody_takes(monkeypatch):
    monkeypatch.setattr(cv2, "VideoCapture", Camera)
    with open_source(0, queue_size=2) as source:
        time.sleep(0.3)
        frames = list(source)
    assert [(frame.index, frame.dropped) for frame in frames] == [(8, 8), (9, 0)]


def test_a_camera_is_released_when_it_is_left(monkeypatch):
    monkeypatch.setattr(cv2, "VideoCapture", Camera)
    with open_source(0) as source:
        next(source)
    assert cameras[-1].released


@contextmanager
def http_server(body: bytes, announced: int, close: bool):
    """Sends `body` of `announced` bytes to everybody; then hangs up, or keeps silent."""
    stop = threading.Event()

    def answer(connection: socket.socket) -> None:
        with connection:
            connection.recv(4096)
            head = f"HTTP/1.1 200 OK\r\nContent-Type: video/x-msvideo\r\nContent-Length: {announced}\r\n\r\n"
            try:
                connection.sendall(head.encode() + body)
                if not close:
                    stop.wait(10.0)
            except OSError:
                pass

    def serve() -> None:
        while not stop.is_set():
            try:
                connection, _ = listener.accept()
            except OSError:
                return
            threads.append(threading.Thread(target=answer, args=(connection,)))
            threads[-1].start()

    threads: list[threading.Thread] = []
    with socket.create_server(("127.0.0.1", 0)) as listener:
        threads.append(threading.Thread(target=serve))
        threads[0].start()
        try:
            yield f"http://user:secret@127.0.0.1:{listener.getsockname()[1]}/live.avi?key=secret"
        finally:
            stop.set()
            listener.shutdown(socket.SHUT_RDWR)
            for thread in threads:
                thread.join()


def test_a_network_stream(video):
    body = video.read_bytes()
    with http_server(body, len(body), close=True) as url, open_source(url, drop=False) as source:
        frames = list(source)
    assert values(frames) == pytest.approx([20 * k for k in range(12)], abs=3)
    assert "secret" not in source.ended
    assert source.broke_off


def test_a_network_stream_that_falls_silent(tmp_path):
    path = tmp_path / "long.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 25, (WIDTH, HEIGHT))
    for index in range(400):  # FFmpeg wants to see five seconds before it opens a stream
        writer.write(image(index // 2))
    writer.release()
    body = path.read_bytes()
    half = body[: len(body) // 2]
    start = time.monotonic()
    with http_server(half, len(body), close=False) as url, open_source(url, drop=False, stall_seconds=1.5) as source:
        frames = list(source)
    assert 100 < len(frames) < 250
    assert values(frames) == pytest.approx([k // 2 for k in range(len(frames))], abs=3)
    assert time.monotonic() - start < 8.0
    assert source.broke_off
