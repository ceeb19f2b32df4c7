"""What is closed leaves no thread and no process behind, however it came to be closed."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import gtsam
import numpy as np
import pytest

import factorsfm
from factorsfm import DepthKind, Episode, InputError, ModelError, Options, ReconstructionError, Stream
from factorsfm.cli.main import main
from factorsfm.streaming.snapshot import read_snapshot, write_snapshot
from tests.left_alive import nothing_left_alive
from tests.rendered import FRAMES, Maps, quick_presets, rendered, simulated_maps, with_fewer_tracks

OPTIONS = replace(with_fewer_tracks(Options(), 100), lens="fixed", shutter="global")


@pytest.fixture(autouse=True)
def _nothing_left_alive(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.setattr("factorsfm.support.options.PRESETS", quick_presets())
    made, init = [], Stream.__init__

    def remembered(self: Stream, *arguments: Any, **named: Any) -> None:
        made.append(self)  # what ends because it is collected was not closed
        init(self, *arguments, **named)

    monkeypatch.setattr(Stream, "__init__", remembered)
    with nothing_left_alive():
        yield
    assert made


def stream(pushed: int) -> Stream:
    made = Stream(rendered("dolly").camera, depth=Maps(simulated_maps("dolly")), options=OPTIONS)
    for image in rendered("dolly").images[:pushed]:
        made.push(image)
    return made


class Failing(Maps):
    """A prior that raises on one frame."""

    def __init__(self, frame: int, error: BaseException) -> None:
        super().__init__(simulated_maps("dolly"))
        self._frame, self._error = frame, error

    def __call__(self, frame: factorsfm.Frame) -> factorsfm.DepthMap | None:
        if frame.index == self._frame:
            raise self._error
        return super().__call__(frame)


def write_images(folder: Path, images: list[np.ndarray]) -> Path:
    for k, image in enumerate(images):
        cv2.imwrite(str(folder / f"{k}.png"), image)
    return folder


def breaking_off(after: int, error: BaseException) -> Iterator[np.ndarray]:
    yield from rendered("dolly").images[:after]
    raise error


# --- the stream -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("pushed", [0, 1, FRAMES])
def test_a_stream_that_is_given_up(pushed: int) -> None:
    stream(pushed).close()


def test_a_stream_that_is_finished() -> None:
    stream(FRAMES).finish()


@pytest.mark.parametrize("pushed", [0, 1])
def test_a_stream_that_cannot_be_finished(pushed: int) -> None:
    with pytest.raises(ReconstructionError):
        stream(pushed).finish()


def test_a_closed_stream_takes_no_frame_and_keeps_what_it_knows() -> None:
    s = stream(FRAMES)
    s.close()
    with pytest.raises(InputError, match="the stream is closed and takes no further frame"):
        s.push(rendered("dolly").images[0])
    with pytest.raises(InputError, match="the stream is closed and has no graph any more"):
        s.graph()
    with pytest.raises(InputError, match="the stream is closed and takes no factors"):
        s.add_factors(gtsam.NonlinearFactorGraph(), gtsam.Values())
    assert len(s.frames) == FRAMES
    assert all(pose is not None for pose in s.trajectory())


def test_a_snapshot_that_holds_no_stream(tmp_path: Path) -> None:
    with stream(2) as s:
        s.save(tmp_path / "state")
    state = read_snapshot(tmp_path / "state")
    write_snapshot(tmp_path / "broken", {**state, "mapper": {}})
    with pytest.raises(InputError, match="does not hold the state of a stream"):
        Stream.load(tmp_path / "broken")


# --- the one call -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("error", [RuntimeError("the cable"), KeyboardInterrupt()])
@pytest.mark.parametrize("where", ["source", "depth", "masks", "progress", "progress of the end"])
def test_a_reconstruction_that_something_ends(where: str, error: BaseException) -> None:
    def raises(*arguments: object) -> None:
        raise error

    def progress(stage: str, done: int, total: int | None) -> None:
        if (where == "progress" and done == 5) or (where == "progress of the end" and stage != "frames"):
            raise error

    shot = rendered("dolly")
    named = where in ("depth", "masks") and isinstance(error, Exception)
    with pytest.raises(ModelError if named else type(error)):
        factorsfm.reconstruct(
            breaking_off(5, error) if where == "source" else shot.images,
            camera=shot.camera,
            depth=Failing(0, error) if where == "depth" else Maps(simulated_maps("dolly")),
            masks=raises if where == "masks" else None,
            progress=progress,
        )


# --- live sources and films -------------------------------------------------------------------------------------


@pytest.mark.parametrize("finished", [False, True])
def test_a_source_that_is_followed_for_a_while(tmp_path: Path, finished: bool) -> None:
    write_images(tmp_path, rendered("dolly").images)
    live = factorsfm.track(tmp_path, camera=rendered("dolly").camera, depth=None)
    for _ in range(3):
        next(live)
    if finished:
        live.finish()
    else:
        live.close()


def film() -> list[np.ndarray]:
    other = [np.ascontiguousarray(image[::-1, ::-1]) for image in rendered("truck").images]
    return [*rendered("dolly").images, *other]


def test_a_film_that_is_given_up() -> None:
    episode = Episode(rendered("dolly").camera, options=OPTIONS)
    for image in [*film(), *film()[:5]]:
        episode.push(image)
    episode.close()  # a shot is being polished or waits for that, and another goes on


def test_a_film_whose_results_cannot_be_taken() -> None:
    def full(shot: factorsfm.ShotResult) -> None:
        raise OSError("disk full")

    episode = Episode(rendered("dolly").camera, options=OPTIONS, finished=full)
    for image in film():
        episode.push(image)
    with pytest.raises(OSError, match="disk full"):
        episode.finish()


# --- the command ------------------------------------------------------------------------------------------------


@pytest.fixture
def images(tmp_path: Path) -> Path:
    """The dolly as a folder."""
    shot = rendered("dolly").images
    (tmp_path / "images").mkdir()
    return write_images(tmp_path / "images", shot)


@pytest.mark.parametrize("more", [[], ["--cuts"]])
def test_a_command_that_a_prior_ends(
    images: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, more: list[str]
) -> None:
    def fails(frame: factorsfm.Frame) -> factorsfm.DepthMap:
        raise RuntimeError("out of memory")

    fails.kind, fails.name = DepthKind.INVERSE, "fails"
    monkeypatch.setattr("factorsfm.cli.stream.open_depth", lambda *arguments: fails)
    assert main(["stream", str(images), "--output", str(tmp_path / "out"), *more]) == 2


def test_a_command_that_cannot_go_on_from_a_snapshot(images: Path, tmp_path: Path) -> None:
    with stream(2) as s:
        s.save(tmp_path / "state")
    arguments = ["--resume", str(tmp_path / "state"), "--preset", "geometry", "--depth", "none"]
    assert main(["stream", str(images), "--output", str(tmp_path / "out"), *arguments]) == 2
