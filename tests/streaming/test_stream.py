"""The stream: what it takes, what it refuses, and that it equals the one call."""

import os
import signal
from dataclasses import replace

import cv2
import numpy as np
import pytest

import factorsfm
from factorsfm import (
    Frame,
    FrameStatus,
    FrameUpdate,
    InputError,
    ModelError,
    Options,
    Reconstruction,
    ReconstructionError,
    ShotKind,
    Stream,
)
from factorsfm.camera.projection import pixels_from_normalized
from factorsfm.evaluation.useless_priors import RandomSmoothPrior
from factorsfm.mapping.mapper import Mapper
from factorsfm.synthetic import render_moving, render_shot, simulate_prior
from tests.left_alive import children
from tests.rendered import FRAMES, Maps, errors_of, quick_presets, rendered, simulated_maps, with_fewer_tracks

QUICK = with_fewer_tracks(Options())


def stream(motion="dolly", **arguments) -> Stream:
    arguments.setdefault("depth", Maps(simulated_maps(motion)))
    arguments.setdefault("options", QUICK)
    return Stream(arguments.pop("camera", rendered(motion).camera), **arguments)


def poses(result: Reconstruction) -> np.ndarray:
    return np.array([frame.cam_from_world.matrix() for frame in result.frames])


@pytest.fixture(scope="module")
def run() -> tuple[list[FrameUpdate], Reconstruction]:
    s = stream()
    updates = [s.push(image) for image in rendered("dolly").images]
    return updates, s.finish()


def test_every_frame_has_a_causal_pose(run):
    updates, _ = run
    shot = rendered("dolly")
    assert [u.index for u in updates] == list(range(FRAMES))
    assert {u.status for u in updates} == {FrameStatus.REGISTERED}
    assert updates[0].keyframe
    assert all(30 <= u.inliers <= u.tracks <= 250 for u in updates)
    turns = [
        np.degrees((u.cam_from_world.rotation * true.rotation.inverse()).angle())
        for u, true in zip(updates, shot.cam_from_world, strict=True)
    ]
    assert 0.01 < max(turns) < 0.1
    z = [u.cam_from_world.inverse().translation[2] for u in updates]
    assert np.all(np.diff(z) > 0)  # the dolly goes forward


def test_new_points_are_those_that_the_map_gained():
    with stream() as s:
        for image in rendered("dolly").images:
            before = len(s.points[0])
            gained = s.push(image).new_points
            assert gained >= len(s.points[0]) - before  # others may have been taken away
            assert gained >= 30 or before > 0  # the start
        assert len(s.points[0]) > 100


def test_the_polished_path_is_the_true_one(run):
    _, result = run
    error = errors_of(result, rendered("dolly"))
    assert 0.0008 < np.median(error.ate) < 0.005  # share of the path's length
    assert 0.002 < np.median(error.r_rpe) < 0.012  # degrees
    assert result.kind is ShotKind.GENERAL
    assert result.notes == []
    assert 0.03 < result.parallax < 0.07  # 0.05 of the median depth of all pixels
    assert [frame.name for frame in result.frames[:2]] == ["000000", "000001"]
    assert set(result.seconds) >= {"tracking", "depth", "mapping", "polish"}


def test_results_are_deterministic_and_equal_those_of_the_one_call(run, monkeypatch):
    monkeypatch.setattr("factorsfm.support.options.PRESETS", quick_presets())
    _, result = run
    shot = rendered("dolly")
    again = factorsfm.reconstruct(shot.images, camera=shot.camera, depth=Maps(simulated_maps("dolly")))
    np.testing.assert_array_equal(poses(again), poses(result))
    np.testing.assert_array_equal(again.points, result.points)
    np.testing.assert_array_equal(again.colors, result.colors)


def test_two_streams_do_not_disturb_each_other(run):
    updates, _ = run
    one, other = stream(), stream("truck")
    for k, (image, foreign) in enumerate(zip(rendered("dolly").images, rendered("truck").images, strict=True)):
        update = one.push(image)
        other.push(foreign)
        assert (update.tracks, update.inliers) == (updates[k].tracks, updates[k].inliers)
        np.testing.assert_array_equal(update.cam_from_world.matrix(), updates[k].cam_from_world.matrix())


def test_colours_are_those_of_the_picture(run):
    _, result = run
    first = result.observation_frame == 0
    x, y = np.rint(result.observation_xy[first]).astype(int).T
    expected = rendered("dolly").images[0][y, x, ::-1]
    np.testing.assert_array_equal(result.colors[result.observation_point[first]], expected)


@pytest.mark.parametrize("form", ["grey", "grey_channel", "bgra", "uint16", "frame"])
def test_every_form_of_image_gives_the_same_tracks(form):
    def formed(k, image):
        grey = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
        return {
            "grey": grey,
            "grey_channel": grey[..., None],
            "bgra": cv2.cvtColor(image, cv2.COLOR_BGR2BGRA),
            "uint16": image.astype(np.uint16) * 257,
            "frame": Frame(k, grey, f"{k:06d}"),
        }[form]

    plain, other = stream(), stream()
    for k, image in enumerate(rendered("dolly").images[:4]):
        a, b = plain.push(image), other.push(formed(k, image))
        assert (a.status, a.tracks, a.inliers) == (b.status, b.tracks, b.inliers)
        np.testing.assert_array_equal(a.cam_from_world.matrix(), b.cam_from_world.matrix())


@pytest.mark.parametrize(
    ("bad", "reason"),
    [
        (lambda i: i.astype(np.float32) / 255, "frame 2 is an array of float32"),
        (lambda i: i.astype(np.int64), "frame 2 is an array of int64"),
        (lambda i: "frame.png", "frame 2 is of type str"),
        (lambda i: i[..., :2], r"frame 2 has shape \(180, 320, 2\)"),
        (lambda i: i[:0], "frame 2 has shape"),
        (lambda i: i[:90], "frame 2 is 320x90, expected 320x180"),
        (lambda i: i.transpose(1, 0, 2), "frame 2 is 180x320"),
    ],
)
def test_a_refused_frame_leaves_the_stream_as_it_was(bad, reason):
    images = rendered("dolly").images
    s, untouched = stream(), stream()
    for image in images[:2]:
        s.push(image)
        untouched.push(image)
    with pytest.raises(InputError, match=reason):
        s.push(bad(images[2]))
    expected, update = untouched.push(images[2]), s.push(images[2])
    assert (update.index, update.tracks) == (2, expected.tracks)
    np.testing.assert_array_equal(update.cam_from_world.matrix(), expected.cam_from_world.matrix())


def test_a_camera_of_another_size_is_refused():
    camera = factorsfm.guess_camera(640, 360)
    with pytest.raises(InputError, match="camera is made for 640x360 pixels, but the images have 320x180"):
        stream(camera=camera).push(rendered("dolly").images[0])


@pytest.mark.parametrize("pushed", [0, 1])
def test_finish_without_enough_frames(pushed):
    s = stream()
    for image in rendered("dolly").images[:pushed]:
        s.push(image)
    with pytest.raises(ReconstructionError, match=f"frames in the shot: {pushed}, at least 2 needed") as caught:
        s.finish()
    assert len(caught.value.frames) == pushed


def test_an_unknown_lens_is_guessed_and_estimated():
    s = stream(camera=None, options=replace(QUICK, shutter="global"))
    for image in rendered("dolly").images:
        s.push(image)
    result = s.finish()
    assert s.camera.model_name == "SIMPLE_PINHOLE"
    assert (result.camera.width, result.camera.height) == (320, 180)
    assert len(result.registered) == FRAMES
    assert any("focal length" in note for note in result.notes)
    ratio = result.camera.mean_focal_length() / rendered("dolly").camera.mean_focal_length()
    assert 0.7 < ratio < 1.4  # the guess says 50 degrees, the truth is 54


def test_all_frames_are_seen_through_one_focal_length_whenever_the_map_changes_it(monkeypatch):
    extend = Mapper._extend

    def extend_and_change(mapper, image, read_depth):
        extend(mapper, image, read_depth)
        mapper._set_focal(1.01 * mapper.focal)

    monkeypatch.setattr(Mapper, "_extend", extend_and_change)
    s = stream(camera=None)
    changed = []
    for k, image in enumerate(rendered("dolly").images[:8]):
        if k == 6:
            s._mapper._set_focal(0.9 * s._mapper.focal)  # between frames, as `trajectory` may
        update = s.push(image)
        changed.append(update.focal_changed)
        assert update.focal_length == pytest.approx(s.camera.mean_focal_length(), rel=1e-12)
    assert changed == [False] + [True] * 7
    for image in s._mapper.images:
        assert image.tracks.camera == s.camera
        np.testing.assert_allclose(pixels_from_normalized(s.camera, image.tracks.xy), image.tracks.pixels, atol=1e-6)
    s.close()


class Failing(Maps):
    """Fails on some frames."""

    def __init__(self, frames: set[int]) -> None:
        super().__init__(simulated_maps("dolly"))
        self.failing = frames
        self.asked: list[int] = []

    def __call__(self, frame):
        self.asked.append(frame.index)
        if frame.index in self.failing:
            raise RuntimeError("out of memory")
        return super().__call__(frame)


def test_a_lens_that_is_guessed_and_stays_so_is_said_to_be_a_guess():
    images = rendered("dolly").images
    fixed = replace(QUICK, lens="fixed")
    guessed = stream(camera=None, options=fixed)
    given = stream(options=fixed)
    for image in images:
        guessed.push(image)
        given.push(image)
    assert "The focal length is a guess (343 pixels): no camera was given, and the lens was to stay fixed." in (
        guessed.finish().notes
    )
    assert not any("focal length" in note for note in given.finish().notes)


def test_a_depth_network_that_raises_at_once_is_named_with_the_frame():
    s = stream(depth=Failing({0}))
    with pytest.raises(ModelError, match=r"depth prior failed on frame 0: RuntimeError\('out of memory'\)"):
        s.push(rendered("dolly").images[0])
    updates = [s.push(Frame(k, rendered("dolly").images[k], str(k))) for k in range(1, FRAMES)]  # it can go on
    assert {update.status for update in updates} == {FrameStatus.REGISTERED}


@pytest.mark.parametrize("foreign", [1, 2, 5])
def test_a_map_that_the_following_frames_do_not_join_is_given_up(foreign):
    """A shot that was cut too early begins with the end of the one before, or with a fast pan of a few frames."""
    shot, before = render_shot("dolly", 14, 320, 180), render_shot("truck", max(2, foreign), 320, 180, seed=5)
    images = [*before.images[:foreign], *shot.images]
    s = stream(depth=Maps([*simulate_prior(before)[:foreign], *simulate_prior(shot)]))
    updates = [s.push(Frame(k, image, str(k))) for k, image in enumerate(images)]
    assert updates[0].status is FrameStatus.REGISTERED
    assert updates[-1].status is FrameStatus.REGISTERED
    assert "no other image has joined yet" in updates[0].message
    (anew,) = [update for update in updates if update.starts_anew]
    assert anew.index >= foreign + 5
    assert f"the images that follow image {foreign - 1} do not join its map, starting anew" in anew.note
    assert [update.note for update in updates if update is not anew] == [""] * (len(updates) - 1)
    result = s.finish()
    assert [frame.status is FrameStatus.REGISTERED for frame in result.frames] == [False] * foreign + [True] * 14
    assert "none of those that followed joined" in result.frames[0].message
    own = replace(result, frames=result.frames[foreign:])
    assert 0.0007 < np.median(errors_of(own, shot).ate) < 0.005


@pytest.mark.parametrize("mirrored", [False, True])
def test_without_a_prior_that_is_none_the_stream_goes_on(mirrored, caplog):
    """A random field has no order of depths to agree with, and may well be the mirror image of the geometry, too."""
    shot = render_shot("dolly", 30, 320, 180, 0.3)
    maps = simulate_prior(shot)
    far = 1.02 * max(values.max() for values in maps)
    s = stream(camera=shot.camera, depth=Maps([far - values for values in maps]) if mirrored else RandomSmoothPrior())
    updates = [s.push(image) for image in shot.images]
    (anew,) = [update for update in updates if update.note]
    assert anew.starts_anew
    reason = anew.note.removeprefix("going on without the depth prior: ").removesuffix("; starting anew")
    mirror_image = "the geometry is its mirror image in 3 updates in a row"
    assert reason == mirror_image or (not mirrored and reason.startswith("the order of its depths correlates"))
    assert anew.note in caplog.text
    assert anew.index < 26
    assert all(update.cam_from_world is not None for update in updates[27:])
    assert all(update.prior is None for update in updates[anew.index :])
    result = s.finish()
    assert [note for note in result.notes if reason in note]
    assert len(result.registered) == 30
    assert 0.0002 < np.median(errors_of(result, shot).ate) < 0.0013


def test_a_prior_that_is_left_out_stays_so_in_a_snapshot(tmp_path):
    shot = render_shot("dolly", 30, 320, 180, 0.3)
    s = stream(camera=shot.camera, depth=RandomSmoothPrior())
    updates = [s.push(image) for image in shot.images]
    assert sum(update.starts_anew for update in updates) == 1
    s.save(tmp_path / "state")
    s.close()
    again = Stream.load(tmp_path / "state", depth=Failing(set(range(99))))  # is not asked any more
    for k in range(20, 30):
        assert again.push(Frame(k + 10, shot.images[49 - k], str(k))).status is FrameStatus.REGISTERED
    again.close()


@pytest.mark.parametrize("preset", ["default", "paper"])
def test_a_depth_network_that_raises_later_is_done_without(preset, caplog):
    paper = preset == "paper"
    motion = render_shot("dolly", 14, 320, 180) if paper else rendered("dolly")
    depth = Failing(set(range(1, 11)) if not paper else {11, 12, 13})
    depth.maps = simulate_prior(motion)
    s = stream(depth=depth, options=with_fewer_tracks(factorsfm.PRESETS[preset]))
    for image in motion.images:
        s.push(image)
    result = s.finish()
    failed = sorted(depth.failing.intersection(depth.asked))
    assert failed
    assert len(result.registered) == len(motion.images)
    (note,) = [note for note in result.notes if "went without depth" in note]
    assert f"because the prior failed: {len(failed)}; the depth prior failed on frame {failed[0]}: Runtime" in note
    assert [record.levelname for record in caplog.records] == ["WARNING"] * len(failed)
    assert "the frame goes without" in caplog.text
    assert all(result.frames[k].prior is None for k in failed)


@pytest.mark.parametrize(
    ("masks", "error", "reason"),
    [
        (lambda frame: 1 / 0, ModelError, "mask prior failed on frame 0: ZeroDivisionError"),
        (lambda frame: np.zeros((90, 160), bool), InputError, r"mask of frame 0 has shape \(90, 160\)"),
    ],
)
def test_masks_that_cannot_be_used(masks, error, reason):
    with pytest.raises(error, match=reason):
        stream(masks=masks).push(rendered("dolly").images[0])


def test_masked_regions_hold_no_point():
    shot = rendered("dolly")

    def left_half(frame: Frame) -> np.ndarray:
        return np.repeat((np.arange(320) < 160)[None], 180, axis=0)

    s = stream(masks=left_half, options=with_fewer_tracks(Options(), 200))
    for image in shot.images:
        s.push(image)
    result = s.finish()
    assert len(result.registered) == FRAMES
    assert result.observation_xy[:, 0].min() > 159
    assert 0.0007 < np.median(errors_of(result, shot).ate) < 0.0045


def test_no_pixels_are_kept(run):
    """A long stream holds keypoints and points, never images."""
    s = stream(depth=None)
    for image in rendered("dolly").images:
        s.push(image)
    assert all(not isinstance(value, np.ndarray) for seen in s.frames for value in seen.__getstate__())
    per_frame = [image.tracks.pixels.nbytes for image in s._mapper.images]
    assert max(per_frame) <= 250 * 16


def test_options_are_written_with_the_result(run):
    _, result = run
    assert result.options["tracker"]["max_tracks"] == 250
    assert result.options["preset"] == "default"
    other = stream(options=replace(QUICK, preset="mine"))
    assert other.options.to_dict()["preset"] == "mine"


def test_a_graph_whose_process_is_killed_comes_back(run, caplog):
    others = children()
    s = stream()
    updates = []
    for k, image in enumerate(rendered("dolly").images):
        updates.append(s.push(image))
        if k in (2, 5):
            for pid in children() - others:
                os.kill(pid, signal.SIGKILL)
    result = s.finish()
    assert 1 <= len(caplog.messages) <= 2
    assert all("rolled back: the process of the graph was killed by SIGKILL" in m for m in caplog.messages)
    assert {u.status for u in updates} == {FrameStatus.REGISTERED}
    assert 0.0008 < np.median(errors_of(result, rendered("dolly")).ate) < 0.005
    undisturbed = sum(u.keyframe for u in run[0])
    assert undisturbed - len(caplog.messages) <= sum(f.keyframe for f in result.frames) <= undisturbed


def test_what_moves_beside_the_map_is_counted_and_said_while_it_goes_on():
    moving = render_moving("truck", 24, 400, 225, parallax=0.05, size=0.85)
    with Stream(moving.shot.camera) as stream:
        updates = [stream.push(image) for image in moving.shot.images]
    assert 0.25 < updates[-1].at_odds < 0.45  # the box covers 39 % of the last frame
    notes = [update.note for update in updates if "at odds with the map" in update.note]
    assert len(notes) == 1
