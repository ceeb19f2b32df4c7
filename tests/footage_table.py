"""The table of `docs/footage.md`: what goes in, and what comes out or how it is refused. Made by reading such footage.

    python -m tests.footage_table

writes it anew.
"""

import struct
import tempfile
from collections.abc import Callable
from fractions import Fraction
from pathlib import Path

import cv2
import numpy as np
import OpenEXR

from factorsfm.frames.bars import BarDetector
from factorsfm.frames.edits import read_edit
from factorsfm.frames.reading import read_frames
from factorsfm.frames.repeats import RepeatDetector
from factorsfm.support.errors import FactorsfmError
from tests.video_files import FORMATS, HLG, PQ, interlaced, marked_as_sphere, moving_texture, write_video

DOCS = Path(__file__).parents[1] / "docs" / "footage.md"
BEGIN, END = "<!-- made by tests/footage_table.py -->\n", "<!-- end -->\n"
COUNT = 12
Make = Callable[[Path], Path]


def images_of(folder: Path, suffix: str, numbers: range = range(1001, 1013)) -> Path:
    """A numbered sequence of image files."""
    folder.mkdir()
    for number, image in zip(numbers, moving_texture(COUNT), strict=True):
        path = folder / f"plate.{number}{suffix}"
        if suffix == ".exr":
            light = (image[:, :, ::-1] / 255.0).astype(np.float16)
            header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage, "pixelAspectRatio": 2.0}
            with OpenEXR.File(header, {"RGB": np.ascontiguousarray(light)}) as file:
                file.write(str(path))
        else:
            cv2.imwrite(str(path), image.astype(np.uint16) * 257 if suffix in (".png", ".tif") else image)
    return folder


def with_gap(path: Path) -> Path:
    folder = images_of(path, ".png")
    (folder / "plate.1005.png").unlink()
    return folder


def two_sequences(path: Path) -> Path:
    folder = images_of(path, ".png")
    for image in list(folder.iterdir()):
        image.with_suffix(".jpg").write_bytes(cv2.imencode(".jpg", cv2.imread(str(image)))[1])
    return folder


def cut_short(path: Path) -> Path:
    folder = images_of(path, ".png")
    last = folder / "plate.1012.png"
    last.write_bytes(last.read_bytes()[:2000])
    return folder


def of_two_sizes(path: Path) -> Path:
    folder = images_of(path, ".jpg")
    cv2.imwrite(str(folder / "plate.1012.jpg"), np.zeros((60, 80, 3), np.uint8))
    return folder


def link_to_nothing(path: Path) -> Path:
    folder = images_of(path, ".jpg")
    (folder / "plate.1013.jpg").symlink_to("gone.jpg")
    return folder


def without_decoder(path: Path) -> Path:
    file = write_video(path.with_suffix(".avi"), moving_texture(3), "mjpeg", "yuvj420p")
    file.write_bytes(file.read_bytes().replace(b"MJPG", b"XYZW"))
    return file


def bytes_in(content: bytes, suffix: str) -> Make:
    def make(path: Path) -> Path:
        path.with_suffix(suffix).write_bytes(content)
        return path.with_suffix(suffix)

    return make


def video(**how: object) -> Make:
    return lambda path: write_video(path.with_suffix(".mkv"), moving_texture(COUNT), **how)


def boxed(path: Path) -> Path:
    images = moving_texture(COUNT)
    for image in images:
        image[:30] = image[-30:] = 0
    return write_video(path.with_suffix(".mp4"), images)


def repeating(path: Path) -> Path:
    images = moving_texture(COUNT)
    return write_video(path.with_suffix(".mp4"), [images[k - k // 5] for k in range(COUNT)])


def edited(path: Path) -> Path:
    images = moving_texture(2 * COUNT)
    other = [np.ascontiguousarray(255 - image[::-1]) for image in moving_texture(2 * COUNT, 3.0)]
    return write_video(path.with_suffix(".mp4"), images + other)


INPUTS: list[tuple[str, Make]] = [
    *(
        (
            f"{suffix[1:].upper()}, {codec} {pixels}",
            lambda path, f=(suffix, codec, pixels, options): write_video(
                path.with_suffix(f[0]), moving_texture(COUNT), f[1], f[2], options=f[3]
            ),
        )
        for suffix, codec, pixels, options in FORMATS
    ),
    ("MP4 from a phone, turned by 90 degrees", video(rotation=90)),
    ("video with a pixel aspect of 2", video(aspect=Fraction(2))),
    ("video at uneven times", video(times=[0, 4, 8, 12, 20, 28, 36, 40, 44, 52, 60, 64])),
    ("HDR, PQ, 10 bits", video(codec="libx264", pixels="yuv420p10le", color_trc=PQ)),
    ("HDR, HLG, 10 bits", video(codec="libx264", pixels="yuv420p10le", color_trc=HLG)),
    ("interlaced video, top field first", lambda path: interlaced(path.with_suffix(".mp4"), moving_texture(2 * COUNT))),
    (
        "interlaced video, bottom field first",
        lambda path: interlaced(path.with_suffix(".mpg"), moving_texture(2 * COUNT), "mpeg2video", top_first=False),
    ),
    ("letterboxed video", boxed),
    ("24 in 30 frames a second", repeating),
    ("a file with a cut", edited),
    ("EXR sequence, half, pixel aspect 2", lambda path: images_of(path, ".exr")),
    ("PNG sequence of 16 bits", lambda path: images_of(path, ".png")),
    ("TIFF sequence of 16 bits", lambda path: images_of(path, ".tif")),
    ("JPEG sequence", lambda path: images_of(path, ".jpg")),
    ("sequence with a gap", with_gap),
    ("plates and their previews in one folder", two_sequences),
    ("sequence whose last image is still being written", cut_short),
    ("sequence with a link to nothing", link_to_nothing),
    ("images of two sizes", of_two_sizes),
    ("folder without images", lambda path: path.mkdir() or path),
    ("360 degree video", lambda path: marked_as_sphere(write_video(path.with_suffix(".mp4"), moving_texture(COUNT)))),
    ("stereo video, views side by side", video(stereo="left_right")),
    ("codec without decoder", without_decoder),
    ("MP4 that is still being written", bytes_in(struct.pack(">I", 32) + b"ftypisom" + bytes(2000), ".mp4")),
    ("empty file", bytes_in(b"", ".mp4")),
    ("text", bytes_in(b"EDL 001\n" * 40, ".mov")),
    ("nothing at this path", lambda path: path.with_suffix(".mp4")),
    ("a single image", bytes_in(cv2.imencode(".png", moving_texture(1)[0])[1].tobytes(), ".png")),
]


def outcome(source: Path) -> str:
    """What is read of footage in words, or the sentence that refuses it."""
    try:
        frames = list(read_frames(source))
        shots = read_edit(read_frames(source))
    except FactorsfmError as error:
        return "refused: " + str(error).replace(f"{source.parent}/", "")
    first = frames[0]
    height, width = first.image.shape[:2]
    words = [f"{len(frames)} {'fields' if first.is_field else 'frames'} of {width}x{height}"]
    if first.index or frames[-1].index != len(frames) - 1:
        words.append(f"numbers {first.index} to {frames[-1].index}")
    if first.pixel_aspect != 1.0:
        words.append(f"pixel aspect {first.pixel_aspect:g}")
    detector, bars = RepeatDetector(), BarDetector()
    greys = [cv2.cvtColor(frame.image, cv2.COLOR_BGR2GRAY) for frame in frames]
    if len(shots.starts) > 1:
        words.append(f"{len(shots.starts)} shots")
    elif repeats := sum(detector.push(grey) for grey in greys):
        words.append(f"{repeats} repeat the one before")
    picture = [bars.push(grey) for grey in greys][-1]
    if picture is not None:
        words.append(f"bars {picture.said(width, height)}")
    times = [frame.timestamp for frame in frames]
    if None not in times:
        least, most = np.percentile(1e3 * np.diff(times), (0, 100))
        words.append(f"{least:.0f} ms apart" if most - least < 2 else f"{least:.0f} to {most:.0f} ms apart")
    return "; ".join(words)


def table(folder: Path) -> str:
    """The table as Markdown."""
    rows = ["| goes in | comes out |", "|---|---|"]
    for k, (what, make) in enumerate(INPUTS):
        (folder / str(k)).mkdir()
        rows.append(f"| {what} | {outcome(make(folder / str(k) / 'shot'))} |")
    return "\n".join(rows) + "\n"


def written() -> str:
    """The table as it is in the documentation."""
    text = DOCS.read_text(encoding="utf-8")
    return text[text.index(BEGIN) + len(BEGIN) : text.index(END)]


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as made_in:
        DOCS.write_text(DOCS.read_text(encoding="utf-8").replace(written(), table(Path(made_in))), encoding="utf-8")
