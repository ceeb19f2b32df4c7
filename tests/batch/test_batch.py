"""``factorsfm batch``: what it writes, what it survives, and that every way of working gives the same results."""

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from factorsfm import read_result
from factorsfm.batch.crew import WorkerLostError, open_crew
from factorsfm.batch.plan import Job, Method, find_videos, plan_jobs
from factorsfm.camera.files import camera_to_json
from factorsfm.cli.main import main
from factorsfm.support.errors import InputError
from tests.command_line import assert_error, trajectory
from tests.rendered import FRAMES, quick_presets, rendered
from tests.report.chromium import EXECUTABLE, MISSING, Chromium

Run = Callable[..., int]
TIMEOUT = 120.0
SHOTS = [range(FRAMES), range(FRAMES, 2 * FRAMES)]


def write_video(path: Path, images: list[np.ndarray]) -> Path:
    height, width = images[0].shape[:2]
    video = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"mp4v"), 24, (width, height))
    for image in images:
        video.write(image)
    video.release()
    return path


def upside_down(images: list[np.ndarray]) -> list[np.ndarray]:
    return [np.ascontiguousarray(image[::-1, ::-1]) for image in images]


def lonely() -> np.ndarray:
    """A frame of another view, alone: no shot that can be reconstructed."""
    corner = rendered("truck").images[0][:90, :160]
    return np.ascontiguousarray(np.tile(corner[::-1], (2, 2, 1)))


@pytest.fixture
def film(tmp_path: Path) -> Path:
    """Two shots and a bad one."""
    images = [*rendered("dolly").images, *upside_down(rendered("truck").images), lonely()]
    return write_video(tmp_path / "film.mp4", images)


@pytest.fixture
def batch(tmp_path: Path, film: Path, monkeypatch: pytest.MonkeyPatch) -> Run:
    """Runs the command, in this process with fewer tracks."""
    (tmp_path / "camera.json").write_text(json.dumps(camera_to_json(rendered("dolly").camera)))
    monkeypatch.setattr("factorsfm.support.options.PRESETS", quick_presets())

    def run(*arguments: object, source: Path = film, output: str = "out", depth: object = "none") -> int:
        given = ["--output", tmp_path / output, "--camera", tmp_path / "camera.json", "--depth", depth]
        if "--scheduler" not in arguments:
            given += ["--workers", "1"]  # this process; another number that follows replaces it
        return main(["batch", str(source), *map(str, given), *map(str, arguments)])

    return run


def index(folder: Path) -> dict[str, Any]:
    content: dict[str, Any] = json.loads((folder / "index.json").read_text())
    return content


def written(output: Path) -> dict[Path, int]:
    return {path: path.stat().st_mtime_ns for path in output.rglob("summary.json")}


def test_every_shot_has_its_result_and_the_bad_one_its_sentence(
    tmp_path: Path, film: Path, batch: Run, capsys: pytest.CaptureFixture[str]
) -> None:
    assert batch() == 0
    captured = capsys.readouterr()
    assert captured.err == ""
    lines = captured.out.splitlines()
    assert lines[0].startswith(f"film/shot_001, frames 0 to {FRAMES - 1}: all {FRAMES} frames registered")
    assert lines[2].startswith(f"film/shot_003, frames {2 * FRAMES} to {2 * FRAMES}: not reconstructed: ")
    found = index(tmp_path / "out")
    assert (found["shots"], found["done"], found["reconstructed"]) == (3, 3, 2)
    assert (found["frames"], found["registered"]) == (2 * FRAMES + 1, 2 * FRAMES)
    assert [entry["frames"] for entry in found["results"]] == [
        [0, FRAMES],
        [FRAMES, 2 * FRAMES],
        [2 * FRAMES, 2 * FRAMES + 1],
    ]
    assert [entry["grade"] for entry in found["results"]] == ["Solved", "Solved", "Not solved"]
    assert found["results"][2]["verdict"] == "frames in the shot: 1, at least 2 needed"
    assert 0.02 < found["results"][0]["parallax"] < 0.1
    page = (tmp_path / "out" / "index.html").read_text()
    assert "2 of 3 shots are solved." in page
    assert page.count("data:image/jpeg;base64,") == 3
    for entry in found["results"]:
        assert (tmp_path / "out" / entry["folder"] / "report.html").is_file()
        assert f'href="{entry["folder"]}/report.html"' in page
    for number, frames in enumerate(SHOTS, 1):
        once = tmp_path / f"once {number}"
        part = ["--frames", f"{frames.start}:{frames.stop}", "--camera", str(tmp_path / "camera.json")]
        assert main(["reconstruct", str(film), "--output", str(once), "--depth", "none", *part]) == 0
        folder = tmp_path / "out" / "film" / f"shot_{number:03d}"
        np.testing.assert_array_equal(trajectory(folder), trajectory(once))


def test_what_is_done_is_not_done_again(
    tmp_path: Path, film: Path, batch: Run, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert batch() == 0
    first = written(tmp_path / "out")
    said = capsys.readouterr().out
    monkeypatch.setattr("factorsfm.batch.plan.find_shots", None)  # nor are the cuts looked for
    assert batch() == 0
    assert capsys.readouterr().out == said
    assert written(tmp_path / "out") == first
    bad, second = (tmp_path / "out" / "film" / f"shot_00{k}" for k in (3, 2))
    (second / "report.html").unlink()
    assert batch() == 0
    changed = {path.parent for path, time_ in written(tmp_path / "out").items() if time_ != first[path]}
    assert changed == {second}
    assert batch("--preset", "geometry", "--align") == 0
    summary = json.loads((bad / "summary.json").read_text())
    assert summary["options"]["job"]["preset"] == "geometry"
    assert read_result(second).alignment is not None
    assert {path for path, time_ in written(tmp_path / "out").items() if time_ == first[path]} == set()
    monkeypatch.undo()


def test_another_film_in_its_place_is_done_anew(tmp_path: Path, film: Path, batch: Run) -> None:
    assert batch() == 0
    write_video(film, rendered("truck").images)
    assert batch() == 0
    (entry,) = index(tmp_path / "out")["results"]
    assert (entry["frames"], entry["registered"]) == ([0, FRAMES], FRAMES)
    # Nothing is left of the shots that the old one had, and what is no result is not touched.
    assert [path.name for path in (tmp_path / "out" / "film").iterdir()] == ["shot_001"]
    (tmp_path / "out" / "film" / "shot_002").mkdir()
    (tmp_path / "out" / "film" / "shot_002" / "comp.nk").touch()
    film.write_bytes(b"not while it is being copied")
    assert batch() == 2
    assert (entry_folder := tmp_path / "out" / "film" / "shot_001").is_dir()
    write_video(film, rendered("dolly").images)
    assert batch() == 0
    assert {path.name for path in (tmp_path / "out" / "film").iterdir()} == {"shot_001", "shot_002"}
    assert json.loads((entry_folder / "summary.json").read_text())["registered"] == FRAMES


def test_the_results_of_another_source_are_refused(
    tmp_path: Path, batch: Run, capsys: pytest.CaptureFixture[str]
) -> None:
    other = write_video(tmp_path / "other.mp4", [lonely()])
    assert batch(source=other) == 3
    capsys.readouterr()
    before = written(tmp_path / "out")
    assert batch() == 2
    assert_error(capsys.readouterr(), "out holds the shots of", "other.mp4, not of", "film.mp4; choose a new or empty")
    assert written(tmp_path / "out") == before


def test_a_folder_of_videos(tmp_path: Path, batch: Run, capsys: pytest.CaptureFixture[str]) -> None:
    """A damaged video, one that shows nothing, two of the same name, and what is no video."""
    source = tmp_path / "films"
    source.mkdir()
    write_video(source / "b.mp4", rendered("dolly").images)
    write_video(source / "b.avi", [lonely()])
    write_video(source / "black.mp4", [np.zeros((180, 320, 3), np.uint8)] * 3)
    (source / "damaged.mp4").write_bytes(b"no video at all")
    (source / "notes.txt").touch()
    masks, depth = tmp_path / "masks", tmp_path / "depth"
    (masks / "b.mp4").mkdir(parents=True)
    mask = np.zeros((180, 320), np.uint8)
    mask[:, :160] = 255
    cv2.imwrite(str(masks / "b.mp4" / "000003.png"), mask)
    assert batch("--masks", masks, source=source) == 0
    found = index(tmp_path / "out")
    assert [entry["folder"] for entry in found["results"]] == ["b.avi/shot_001", "b.mp4/shot_001"]
    assert [entry["reconstructed"] for entry in found["results"]] == [False, True]
    reasons = {Path(video["video"]).name: video["reason"] for video in found["unread"]}
    assert "all of its frames are blank" in reasons["black.mp4"]
    assert "cannot be decoded" in reasons["damaged.mp4"]
    page = (tmp_path / "out" / "index.html").read_text()
    assert all(reason in page for reason in reasons.values())
    summary = json.loads((tmp_path / "out" / "b.mp4" / "shot_001" / "summary.json").read_text())
    assert summary["options"]["job"]["masks"] == str(masks / "b.mp4")
    (depth / "other").mkdir(parents=True)
    capsys.readouterr()
    assert batch(source=source, output="without maps", depth=depth) == 3
    assert_error(capsys.readouterr(), "none of 2 shots")
    assert "no depth prior" in index(tmp_path / "without maps")["results"][1]["verdict"]


def test_masks_are_those_of_the_whole_video(tmp_path: Path, film: Path) -> None:
    (tmp_path / "masks").mkdir()
    cv2.imwrite(str(tmp_path / "masks" / f"{FRAMES + 2}.png"), np.full((180, 320), 255, np.uint8))
    (video,) = find_videos(film)
    method = Method(masks=str(tmp_path / "masks"))
    jobs = plan_jobs({video: SHOTS}, method, tmp_path / "out", several=False)
    assert [job.method.masks for job in jobs] == [None, str(tmp_path / "masks")]
    method = Method(objects=str(tmp_path / "masks"))
    jobs = plan_jobs({video: SHOTS}, method, tmp_path / "out", several=False)
    assert [job.method.objects for job in jobs] == [None, str(tmp_path / "masks")]


@pytest.mark.parametrize("several", [False, True])
def test_things_are_found_by_their_motion_in_every_shot(tmp_path: Path, film: Path, several: bool) -> None:
    (video,) = find_videos(film)
    jobs = plan_jobs({video: SHOTS}, Method(objects="auto"), tmp_path / "out", several=several)
    assert [job.method.objects for job in jobs] == ["auto", "auto"]


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--camera", "absent.json"], ["absent.json"]),
        (["--depth", "absent"], ["no depth prior absent"]),
        (["--masks", "absent"], ["no masks absent"]),
        (["--masks", "empty"], ["holds no masks"]),
        (["--masks", "other"], ["no mask in", "matches a frame"]),
        (["--objects", "absent"], ["absent", "masks of objects"]),
        (["--workers", "2", "--scheduler", "127.0.0.1:1"], ["--workers", "--scheduler"]),
    ],
)
def test_bad_input(
    tmp_path: Path,
    batch: Run,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    arguments: list[str],
    words: list[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("empty").mkdir()
    Path("other").mkdir()
    cv2.imwrite("other/999.png", np.zeros((180, 320), np.uint8))
    assert batch(*arguments) == 2
    assert_error(capsys.readouterr(), *words)
    assert not (tmp_path / "out").exists()


def test_bad_sources_and_outputs(tmp_path: Path, batch: Run, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "empty").mkdir()
    (tmp_path / "damaged.mp4").write_bytes(b"no video at all")
    black = write_video(tmp_path / "black.mp4", [np.zeros((180, 320, 3), np.uint8)] * 3)
    for source, word in (
        (tmp_path / "absent", "does not exist"),
        (tmp_path / "empty", "holds no videos (avi, "),
        (tmp_path / "damaged.mp4", "cannot be decoded"),
        (black, "all of its frames are blank"),
    ):
        assert batch(source=source) == 2
        assert_error(capsys.readouterr(), word)
        assert not (tmp_path / "out").exists()
    for name, content in (("full/something", "1"), ("foreign/index.json", '{"program": "other"}')):
        (tmp_path / name).parent.mkdir()
        (tmp_path / name).write_text(content)
        assert batch(output=Path(name).parts[0]) == 2
        assert_error(capsys.readouterr(), name.split("/")[0], "choose a new or empty folder")


@pytest.mark.parametrize("count", ["0", "-1", "many"])
def test_bad_number_of_workers(batch: Run, count: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as exit_:
        batch("--workers", count)
    assert exit_.value.code == 2
    assert_error(capsys.readouterr(), "--workers")


def test_only_failures(tmp_path: Path, batch: Run, capsys: pytest.CaptureFixture[str]) -> None:
    source = write_video(tmp_path / "lonely.mp4", [lonely()])
    assert batch(source=source) == 3
    assert_error(capsys.readouterr(), "none of 1 shots could be reconstructed", "lonely/shot_001", "at least 2 needed")
    assert index(tmp_path / "out")["results"][0]["grade"] == "Not solved"


def test_an_unexpected_error_stops_nothing_and_is_tried_again(
    tmp_path: Path, batch: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as patch:
        patch.setattr("factorsfm.api.reconstruct", lambda *_, **__: 1 / 0)
        assert batch() == 3
    results = index(tmp_path / "out")["results"]
    assert [entry["verdict"] for entry in results] == ["ZeroDivisionError: division by zero"] * 3
    assert batch() == 0
    assert index(tmp_path / "out")["reconstructed"] == 2


def test_the_line_of_progress(batch: Run, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sys.stderr.isatty", lambda: True)
    monkeypatch.setattr("shutil.get_terminal_size", lambda: os.terminal_size((200, 24)))
    monkeypatch.setattr("factorsfm.cli.progress_line.ProgressLine._SECONDS_BETWEEN", 0.0)
    assert batch() == 0
    lines = capsys.readouterr().err.split("\r\x1b[K")
    assert "looking for cuts: 1 of 1 videos" in lines
    assert any(line.startswith("1 of 3 shots done, 0:00:0") and line.endswith(" left") for line in lines)
    assert "3 of 3 shots done, 0:00:00 left" in lines


def test_without_dask(batch: Run, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "distributed", None)
    assert batch("--scheduler", "127.0.0.1:1") == 2
    assert_error(capsys.readouterr(), "pip install 'factorsfm[cluster]'")


# What follows runs in processes, where functions are found by their names.


def square_or_die(number: int, *, folder: Path, tries: int) -> int:
    """The square; the process that computes that of 3 is killed the first times."""
    if number == 3 and len(list(folder.iterdir())) < tries:
        (folder / str(os.getpid())).touch()
        os.kill(os.getpid(), signal.SIGKILL)
    if number == 5:
        raise ValueError("five")
    return number * number


@pytest.mark.slow
@pytest.mark.parametrize("tries", [1, 2, 99])
def test_a_pool_survives_a_killed_process(tmp_path: Path, tries: int) -> None:
    with open_crew(2, None) as crew:
        outcomes = dict(crew.run(partial(square_or_die, folder=tmp_path, tries=tries), range(8)))
    assert sorted(outcomes) == list(range(8))
    assert isinstance(outcomes.pop(5), ValueError)
    if tries == 99:
        assert isinstance(outcomes[3], WorkerLostError)
        assert str(outcomes.pop(3)) == "its process ended unexpectedly, 3 times"
        assert len(list(tmp_path.iterdir())) == 3
    assert outcomes == {number: number * number for number in outcomes}


@pytest.mark.parametrize(("cores", "workers"), [(1, 1), (2, 2), (5, 3), (8, 3)])
def test_a_worker_for_every_core_but_not_more_than_shots_and_the_longest_shot_first(
    film: Path, tmp_path: Path, batch: Run, monkeypatch: pytest.MonkeyPatch, cores: int, workers: int
) -> None:
    opened, done = [], []

    @contextmanager
    def crew(count: int, scheduler: str | None) -> Iterator[Any]:
        opened.append(count)
        with open_crew(1, scheduler) as single:
            yield single

    def shot(job: Job, *, one_thread: bool, progress: object) -> None:
        done.append((len(job.frames), one_thread))
        raise InputError("enough")

    monkeypatch.setattr("factorsfm.cli.batch.open_crew", crew)
    monkeypatch.setattr("factorsfm.cli.batch.available_cores", lambda: list(range(cores)))
    monkeypatch.setattr("factorsfm.cli.batch.reconstruct_shot", shot)
    monkeypatch.setattr("factorsfm.batch.plan.find_shots", lambda _, fields: [range(2), range(2, 12), range(12, 16)])
    assert main(["batch", str(film), "--output", str(tmp_path / "out"), "--depth", "none"]) == 3
    assert opened == [1, workers]  # one video, then three shots
    assert done == [(10, cores < 6), (4, cores < 6), (2, cores < 6)]


def test_one_worker_is_this_process() -> None:
    with open_crew(1, None) as crew:
        assert dict(crew.run(lambda _: os.getpid(), [1, 2])) == {1: os.getpid(), 2: os.getpid()}


@pytest.fixture(scope="module")
def serial(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A film, its camera, and in `serial` what one process makes of it."""
    folder = tmp_path_factory.mktemp("serial")
    (folder / "camera.json").write_text(json.dumps(camera_to_json(rendered("dolly").camera)))
    write_video(folder / "film.mp4", [*rendered("dolly").images, *upside_down(rendered("truck").images), lonely()])
    assert run_in(folder, "serial", "--workers", "1") == 0
    return folder


def arguments_of(folder: Path, output: str) -> list[str]:
    given = ["--output", str(folder / output), "--camera", str(folder / "camera.json"), "--depth", "none"]
    return ["batch", str(folder / "film.mp4"), *given]


def run_in(folder: Path, output: str, *arguments: str) -> int:
    return main([*arguments_of(folder, output), *arguments])


def assert_equal_to_serial(folder: Path, output: str) -> None:
    for number in (1, 2):
        one, other = (trajectory(folder / name / "film" / f"shot_00{number}") for name in ("serial", output))
        np.testing.assert_allclose(other, one, atol=1e-9)
    one, other = (index(folder / name) for name in ("serial", output))
    for content in (one, other):
        del content["seconds"]
        for entry in content["results"]:
            del entry["seconds"]
    assert one == other


@pytest.mark.slow
def test_two_processes_give_the_same(serial: Path) -> None:
    assert run_in(serial, "pool", "--workers", "2") == 0
    assert_equal_to_serial(serial, "pool")


@pytest.mark.slow
def test_an_interrupt_ends_all_processes_and_the_next_run_goes_on(serial: Path) -> None:
    command = [sys.executable, "-m", "factorsfm", *arguments_of(serial, "interrupted"), "--workers", "2"]
    with subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True) as process:
        wait_for(lambda: (serial / "interrupted" / "index.json").exists())
        time.sleep(0.5)
        process.send_signal(signal.SIGINT)
        assert process.wait(10) == 130
        assert process.stderr is not None
        assert process.stderr.read() == "factorsfm: interrupted\n"
    assert index(serial / "interrupted")["done"] < 3
    assert run_in(serial, "interrupted", "--workers", "2") == 0
    assert_equal_to_serial(serial, "interrupted")


def wait_for(condition: Callable[[], bool]) -> None:
    end = time.monotonic() + TIMEOUT
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.02)


@contextmanager
def dask(*arguments: str) -> Iterator[subprocess.Popen[str]]:
    """A process of the cluster."""
    command = [sys.executable, "-m", "distributed.cli." + arguments[0], *arguments[1:]]
    process = subprocess.Popen(command, stderr=subprocess.DEVNULL, stdout=subprocess.DEVNULL, text=True)
    try:
        yield process
    finally:
        process.kill()
        process.wait()


@contextmanager
def cluster(folder: Path) -> Iterator[tuple[str, dict[str, subprocess.Popen[str]]]]:
    """Address of a scheduler on this machine, and its two workers by their names: processes without nannies."""
    file = folder / "scheduler.json"
    where = ["--host", "127.0.0.1", "--port", "0", "--no-dashboard"]
    with dask("dask_scheduler", *where, "--scheduler-file", str(file)):
        wait_for(lambda: file.exists() and file.read_text().endswith("}"))
        address = json.loads(file.read_text())["address"]
        worker = ["dask_worker", address, "--nthreads", "1", "--no-nanny", "--no-dashboard"]
        worker += ["--local-directory", str(folder)]
        with dask(*worker, "--name", "one") as one, dask(*worker, "--name", "other") as other:
            yield address, {"one": one, "other": other}


@pytest.mark.slow
def test_a_cluster_gives_the_same_though_a_worker_is_killed(
    serial: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    distributed = pytest.importorskip("distributed")
    with cluster(tmp_path) as (address, workers), distributed.Client(address, set_as_default=False) as client:
        command = [sys.executable, "-m", "factorsfm", *arguments_of(serial, "cluster"), "--scheduler", address]
        with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
            wait_for(lambda: (serial / "cluster" / "index.json").exists())
            wait_for(lambda: len(client.processing()) == 2 and all(client.processing().values()))
            assert index(serial / "cluster")["done"] == 0
            workers["one"].kill()
            said, complained = process.communicate(timeout=TIMEOUT)
        assert (process.returncode, complained) == (0, "")
        assert said.startswith(f"film/shot_001, frames 0 to {FRAMES - 1}: all {FRAMES} frames registered")
        assert_equal_to_serial(serial, "cluster")
        assert [worker["name"] for worker in client.scheduler_info()["workers"].values()] == ["other"]
    monkeypatch.setattr("factorsfm.batch.crew._CONNECT_SECONDS", 1)
    assert run_in(serial, "nobody", "--scheduler", address) == 2
    assert f"the Dask scheduler {address} does not answer" in capsys.readouterr().err


@pytest.mark.skipif(EXECUTABLE is None, reason=MISSING)
@pytest.mark.parametrize(("size", "dark"), [((1280, 900), False), ((360, 700), True)])
def test_the_page_in_a_browser(serial: Path, tmp_path: Path, size: tuple[int, int], dark: bool) -> None:
    browser = Chromium(tmp_path / "profile")
    try:
        browser.open(serial / "serial" / "index.html", size, dark)
        assert browser.run("document.documentElement.scrollWidth - innerWidth") <= 0
        assert browser.run("Array.from(document.images, image => image.naturalWidth)") == [240] * 3
        links = browser.run("Array.from(document.links, link => link.href)")
        assert links == [(serial / "serial" / "film" / f"shot_00{k}" / "report.html").as_uri() for k in (1, 2, 3)]
        assert browser.complaints == []
        assert [url for url in browser.requests if not url.startswith("data:")] == [
            (serial / "serial" / "index.html").as_uri()
        ]
    finally:
        browser.close()
