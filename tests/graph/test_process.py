"""The graph in a process of its own: the same results, and a life that ends with the parent's and not with its own."""

import logging
import multiprocessing.spawn
import os
import pickle
import re
import signal
import subprocess
import sys
import threading
import time
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest

from factorsfm.graph import process as graph_process
from factorsfm.graph.keyframe_graph import KeyframeGraph
from factorsfm.graph.process import GraphProcess, GraphProcessKilledError
from factorsfm.mapping.graph_updates import submit_update
from factorsfm.mapping.map_copy import MapCopy
from factorsfm.mapping.map_update import update_map
from factorsfm.mapping.point_map import PointMap
from factorsfm.support.errors import FactorsfmError
from factorsfm.support.options import MapperOptions
from factorsfm.support.threads import OneThreadEach
from tests.estimation_problems import image_depth, make_problem, mapped_images, perturbed
from tests.graph import updates

OPTIONS = MapperOptions(landmarks=200)
ROOT = Path(__file__).parents[2]

pytestmark = pytest.mark.skipif(os.name != "posix", reason="signals and process groups are those of POSIX")


class Shot:
    """Keyframes near their true poses, and a map near the true points."""

    def __init__(self, frames=8, points=120):
        self.problem = make_problem("handheld", frames=frames, points=points, parallax=0.1, noise_px=0.1)
        near = perturbed(self.problem.truth, angle_rad=0.001, shift=0.003, structure=0.03)
        self.images = mapped_images(self.problem, near, guided=range(0, frames, 3))
        self.points = PointMap()
        self.points.set(np.arange(len(near.points)), near.points)

    def copy(self, keyframes):
        images = [replace(image) for image in self.images[:keyframes]]
        return MapCopy(images, self.points.copy(), OPTIONS, self.problem.focal)

    def mirrored(self, keyframes):
        """A copy that no graph accepts."""
        copy = self.copy(keyframes)
        copy.newest.rotation = np.diag([-1.0, 1.0, -1.0]) @ copy.newest.rotation
        return copy


@pytest.fixture(scope="module")
def shot():
    return Shot()


@pytest.fixture
def graph():
    with GraphProcess() as graph:
        yield graph


def pid_of(graph):
    return graph.ask(updates.pid, None)


def assert_equal(a, b):
    np.testing.assert_equal(asdict(a), asdict(b))


def has_ended(pid):
    """Whether a process is gone, or nothing of it is left but its status."""
    done = subprocess.run(["ps", "-o", "stat=", "-p", str(pid)], capture_output=True, text=True)
    return done.stdout.strip()[:1] in ("", "Z")


def wait_until(true, seconds=20.0):
    end = time.monotonic() + seconds
    while not true():
        assert time.monotonic() < end, "waited in vain"
        time.sleep(0.02)


# --- the updates ------------------------------------------------------------------------------------------------


def test_updates_are_those_of_a_graph_in_this_process(graph, shot):
    here = KeyframeGraph()
    for keyframes in (1, 2, 5, 8):
        update = submit_update(graph, shot.copy(keyframes), None).result()
        assert update.committed
        assert_equal(update, update_map(shot.copy(keyframes), here))


def test_what_is_left_out_of_a_request_makes_no_difference(graph):
    shot = Shot(frames=30)
    for k, image in enumerate(shot.images[:14]):  # the constant ones that share most, and one that shares too little
        seen = len(image.tracks.ids) - 5 * k if k != 6 else 10
        image.tracks = replace(image.tracks.of(image.tracks.ids < seen), depth=None)
    shot.points.set(5000 + np.arange(100), np.ones((100, 3)))  # what none of these keyframes sees
    assert len(shot.copy(30).needed().keyframes) == 24
    update = submit_update(graph, shot.copy(30), None).result()
    assert update.committed
    with OneThreadEach():  # more of them add in another order
        assert_equal(update, update_map(shot.copy(30), KeyframeGraph()))


def test_requests_do_not_grow_with_the_shot():
    shot = Shot(frames=60)
    sizes = []
    for keyframes in (30, 60):
        shot.points.set(1000 * keyframes + np.arange(500), np.ones((500, 3)))
        sizes.append(len(pickle.dumps(shot.copy(keyframes).needed(), pickle.HIGHEST_PROTOCOL)))
    assert sizes[1] == pytest.approx(sizes[0], rel=0.05)


def test_the_prior_is_read_here_and_once(graph, shot):
    copy, calls = shot.copy(2), []

    def read():
        calls.append(os.getpid())
        return image_depth(shot.problem, 1, copy.newest.tracks.ids)

    update = submit_update(graph, copy, read).result()
    assert calls == [os.getpid()]
    np.testing.assert_array_equal(update.depth.inverse_depth, read().inverse_depth)


def test_a_reader_that_fails_says_so(graph, shot):
    def read():
        raise RuntimeError("out of memory")

    with pytest.raises(RuntimeError, match="out of memory"):
        submit_update(graph, shot.copy(2), read).result()
    assert submit_update(graph, shot.copy(2), None).result().committed


def test_errors_of_an_update_are_raised_here(graph, shot):
    with pytest.raises(AttributeError, match="graph_depth") as caught:
        submit_update(graph, replace(shot.copy(2), options=None), None).result()
    assert "map_update.py" in caught.value.__notes__[0]
    assert submit_update(graph, shot.copy(2), None).result().committed


def test_what_is_logged_there_is_logged_here(graph, shot, caplog):
    assert submit_update(graph, shot.copy(7), None).result().committed
    with caplog.at_level(logging.WARNING):
        update = submit_update(graph, shot.mirrored(8), None).result()
    assert not update.committed
    assert [(record.name, record.levelname) for record in caplog.records] == [
        ("factorsfm.graph.keyframe_graph", "WARNING")
    ]
    assert caplog.messages == [f"update at frame 7 rolled back: {update.reason}"]


def test_what_libraries_print_there_is_not_seen(capfd):
    with GraphProcess() as graph:  # started under the capture
        assert graph.ask(updates.print_from_a_library, "subject") == "subject"
    assert capfd.readouterr() == ("", "")


def test_another_map_begins_with_an_empty_graph(graph, shot):
    submit_update(graph, shot.copy(8), None).result()
    graph.start_anew()
    assert_equal(submit_update(graph, shot.copy(4), None).result(), update_map(shot.copy(4), KeyframeGraph()))


# --- the process ------------------------------------------------------------------------------------------------


def test_two_maps_at_once_have_a_process_each_and_leave_none(shot):
    with GraphProcess() as first, GraphProcess() as second:
        pending = [submit_update(graph, shot.copy(4), None) for graph in (first, second)]
        assert_equal(pending[0].result(), pending[1].result())
        pids = [pid_of(first), pid_of(second)]
    assert len(set(pids)) == 2
    assert all(map(has_ended, pids))


def test_a_graph_that_is_forgotten_ends_its_process(shot):
    graph = GraphProcess()
    submit_update(graph, shot.copy(2), None).result()
    pid = pid_of(graph)
    del graph
    wait_until(lambda: has_ended(pid))


def test_killed_in_the_middle_of_an_update(graph, shot, caplog):
    assert submit_update(graph, shot.copy(4), None).result().committed
    pid = pid_of(graph)
    os.kill(pid, signal.SIGSTOP)
    pending = submit_update(graph, shot.copy(5), None)
    time.sleep(0.2)
    assert not pending.done()
    os.kill(pid, signal.SIGKILL)
    update = pending.result()
    reason = "the process of the graph was killed by SIGKILL"
    assert (update.position, update.committed, update.reason) == (4, False, reason)
    assert (len(update.ids), update.poses) == (0, {})
    assert caplog.messages == [f"update at frame 4 rolled back: {reason}"]
    assert has_ended(pid)
    # The graph comes back from the map.
    assert_equal(submit_update(graph, shot.copy(6), None).result(), update_map(shot.copy(6), KeyframeGraph()))
    assert pid_of(graph) != pid


def test_killed_between_two_updates(graph, shot):
    submit_update(graph, shot.copy(2), None).result()
    pid = pid_of(graph)
    os.kill(pid, signal.SIGKILL)
    wait_until(lambda: has_ended(pid))  # all of its threads
    assert not submit_update(graph, shot.copy(3), None).result().committed
    assert submit_update(graph, shot.copy(3), None).result().committed


@pytest.mark.parametrize(
    ("update", "reason"),
    [
        (updates.never, "killed because it gave no answer within 0.5 s"),
        (updates.torn, "killed because its answer cannot be understood: ValueError("),
        (updates.no_answer, "killed because its answer cannot be understood: it is of type str"),
    ],
    ids=["none", "torn", "another"],
)
def test_a_process_that_does_not_answer_as_it_should_is_not_used_again(graph, shot, monkeypatch, update, reason):
    assert graph.ask(updates.echo, 1) == 1
    pid = pid_of(graph)
    monkeypatch.setattr(graph_process, "_SECONDS_TO_ANSWER", 0.5)
    monkeypatch.setattr(graph_process, "_SECONDS_TO_END", 0.5)
    with pytest.raises(GraphProcessKilledError, match=re.escape(f"the process of the graph was {reason}")):
        graph.ask(update, None)
    monkeypatch.undo()
    assert has_ended(pid)
    assert_equal(submit_update(graph, shot.copy(4), None).result(), update_map(shot.copy(4), KeyframeGraph()))
    assert pid_of(graph) != pid


def test_an_answer_that_nobody_waited_for_is_not_taken_for_the_next(graph):
    assert graph.ask(updates.echo, 1) == 1
    pid = pid_of(graph)
    interrupt = threading.Timer(0.3, os.kill, (os.getpid(), signal.SIGINT))
    interrupt.start()
    with pytest.raises(KeyboardInterrupt):
        graph.ask(updates.slow_echo, 2)
    assert graph.ask(updates.echo, 3) == 3
    assert has_ended(pid)


def test_a_fork_of_the_parent_leaves_it_alone(graph, shot):
    submit_update(graph, shot.copy(2), None).result()
    pid = pid_of(graph)
    fork = os.fork()
    if fork == 0:
        graph.close()
        os._exit(0)
    assert os.waitpid(fork, 0)[1] == 0
    assert submit_update(graph, shot.copy(2), None).result().committed
    assert pid_of(graph) == pid


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_signals_that_end_the_parent_are_left_to_the_parent(graph, shot, number):
    assert submit_update(graph, shot.copy(2), None).result().committed
    os.kill(pid_of(graph), number)
    assert submit_update(graph, shot.copy(3), None).result().committed


@pytest.fixture
def broken_interpreter(tmp_path):
    broken = tmp_path / "python"
    broken.write_text("#!/bin/sh\nexit 3\n")
    broken.chmod(0o755)
    before = multiprocessing.spawn.get_executable()
    multiprocessing.set_executable(str(broken))
    yield
    multiprocessing.set_executable(before)


def test_an_interpreter_that_cannot_run_is_an_error(shot, broken_interpreter):
    with GraphProcess() as graph, pytest.raises(FactorsfmError, match="the process of the graph ended with status 3"):
        submit_update(graph, shot.copy(2), None).result()


# --- scripts ----------------------------------------------------------------------------------------------------

# No guard of `__main__`: whoever imported it again would print again, and so on.
SCRIPT = """
import signal, sys, time
sys.path[:0] = [{root!r}]
from tests.graph.test_process import GraphProcess, Shot, pid_of, submit_update

shot, graph = Shot(), GraphProcess()
print("begins", pid_of(graph), flush=True)
print(submit_update(graph, shot.copy(3), None).result().reason, flush=True)
"""


def start(tmp_path, more=""):
    script = tmp_path / "script.py"
    script.write_text(SCRIPT.format(root=str(ROOT)) + more)
    process = subprocess.Popen(
        [sys.executable, "-X", "dev", str(script)],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True,
    )  # fmt: skip
    begins, pid = process.stdout.readline().split()
    assert begins == "begins"
    assert process.stdout.readline() == "committed\n"
    return process, int(pid)


def test_a_script_needs_no_guard_and_leaves_nothing_behind(tmp_path):
    process, pid = start(tmp_path)
    output, errors = process.communicate(timeout=60)
    assert (output, errors, process.returncode) == ("", "", 0)
    assert has_ended(pid)


def test_it_ends_with_a_parent_that_is_killed(tmp_path):
    process, pid = start(tmp_path, "time.sleep(60)")
    assert not has_ended(pid)
    process.kill()
    process.communicate(timeout=60)
    wait_until(lambda: has_ended(pid))


def test_ctrl_c_is_for_the_parent_alone(tmp_path):
    more = """
try:
    print("waiting", flush=True)
    time.sleep(60)
except KeyboardInterrupt:
    print(submit_update(graph, shot.copy(5), None).result().reason)
    print(pid_of(graph))
"""
    process, pid = start(tmp_path, more)
    assert process.stdout.readline() == "waiting\n"
    os.killpg(process.pid, signal.SIGINT)
    output, errors = process.communicate(timeout=60)
    assert (output, errors, process.returncode) == (f"committed\n{pid}\n", "", 0)
    assert has_ended(pid)
