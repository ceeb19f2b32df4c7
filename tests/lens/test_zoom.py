"""A zoom: followed in every frame, told from motion, and not found where there is none."""

from dataclasses import replace

import numpy as np
import pytest

from factorsfm import Options, Stream
from factorsfm.lens.lens import through
from factorsfm.polish.polish import polish
from factorsfm.polish.shot import Shot
from factorsfm.report.result_folder import write_folder
from factorsfm.result.notes import _motion_notes, lens_note, result_doubts
from factorsfm.result.reading import read_result
from factorsfm.result.summary import focal_range, summary
from factorsfm.support.options import DETERMINED_FOCAL_STD
from factorsfm.support.status import ShotKind
from factorsfm.synthetic import render_shot, simulate_prior
from tests.estimation_problems import angles_between, make_problem, mapped_images
from tests.rendered import Maps, errors_of, with_fewer_tracks

FRAMES = 16


def profile(zoom, frames=FRAMES):
    time = np.linspace(0, 1, frames)
    return zoom ** (time**2 * (3 - 2 * time))


def polished(motion, zoom, *, parallax, guess=1.15, max_frames=400, noise_px=0.05, lens="zoom"):
    """The polish of a shot that zooms, from tracks normalised by one wrong focal length and a map without zoom."""
    problem = make_problem(motion, frames=FRAMES, points=200, parallax=parallax, noise_px=noise_px)
    o = problem.observations
    start = through(problem.truth, guess * np.exp(problem.truth.log_focal))
    seen = replace(problem, observations=replace(o, pixels=o.pixels * profile(zoom)[o.frame, None]))
    options = replace(Options.preset_named("geometry"), lens=lens)
    options = replace(options, polish=replace(options.polish, max_frames=max_frames))
    points = np.arange(len(start.bearing)), start.points
    focal = guess * np.exp(problem.truth.log_focal)
    images = mapped_images(seen, start, guess=guess)
    return problem, polish(Shot.of(images, points, focal, seconds=np.arange(len(images)) / 24), options)


@pytest.mark.parametrize(("motion", "parallax"), [("arc", 0.3), ("rotation", 0.0)])
@pytest.mark.parametrize("zoom", [1.4, 0.8])
def test_a_zoom_is_followed_in_every_frame(motion, parallax, zoom):
    problem, result = polished(motion, zoom, parallax=parallax)
    error = np.log(result.state.focal / (problem.focal * profile(zoom)))
    assert result.lens.determined
    assert 5e-5 < np.abs(error).max() < 2e-3
    assert 8e-4 < result.lens.focal_std.max() < 5e-3 < DETERMINED_FOCAL_STD
    assert 4e-5 < angles_between(result.state.rotation, problem.truth.rotation).max() < 3e-4
    assert result.motion.kind is (ShotKind.ROTATION if motion == "rotation" else ShotKind.GENERAL)


def test_the_course_of_a_zoom_is_known_where_the_focal_length_is_not():
    _, result = polished("static", 1.4, parallax=0.0)
    assert not result.lens.determined
    course = result.state.focal / result.state.focal[0]
    np.testing.assert_allclose(course, profile(1.4), rtol=1e-4)
    assert 1e-5 < result.lens.zoom_std < 1e-4
    assert result.motion.kind is ShotKind.STATIC


def test_no_zoom_is_found_where_there_is_none():
    problem, result = polished("arc", 1.0, parallax=0.3)
    assert len(result.state.log_focal) == 1
    assert result.lens.determined
    assert 1e-4 < result.lens.zoom_std < 1e-3
    assert result.state.focal[0] == pytest.approx(problem.focal, rel=0.0015)


@pytest.mark.parametrize("motion", ["arc", "handheld", "rotation"])
def test_a_zoom_that_nobody_announced_is_recognised(motion):
    _, result = polished(motion, 1.4, parallax=0.0 if motion == "rotation" else 0.2, lens="distortion")
    assert not result.lens.announced
    assert result.lens.zooms
    course = result.state.focal / result.state.focal[0]
    np.testing.assert_allclose(course, profile(1.4), rtol=3e-3)
    assert "Nobody announced this zoom" in lens_note(result.lens)
    assert result.motion.kind is (ShotKind.ROTATION if motion == "rotation" else ShotKind.GENERAL)
    assert result.zoom == 0.0


def test_a_fixed_camera_that_zooms_does_not_travel():
    """To one focal length, a zoom is a way towards a wall."""
    _, result = polished("static", 1.4, parallax=0.0, lens="distortion")
    assert result.lens.zooms
    assert result.motion.kind is ShotKind.STATIC
    np.testing.assert_allclose(result.state.focal / result.state.focal[0], profile(1.4), rtol=1e-3)
    assert _motion_notes(result, False)[0].startswith("The camera stays where it is and only zooms;")


@pytest.mark.parametrize(
    ("motion", "parallax", "noise_px"),
    [("dolly", 0.2, 0.05), ("dolly", 0.1, 0.6), ("dolly", 0.03, 0.05), ("handheld", 0.05, 0.05), ("arc", 0.3, 0.05)],
)
def test_a_move_is_no_zoom(motion, parallax, noise_px):
    """Not behind much noise, either."""
    _, result = polished(motion, 1.0, parallax=parallax, noise_px=noise_px, lens="distortion")
    assert len(result.state.log_focal) == 1
    assert result.lens.zoom_std is None
    assert result.motion.kind is ShotKind.GENERAL


def test_a_given_lens_is_kept_where_the_tracks_ask_for_a_zoom():
    problem, result = polished("handheld", 1.4, parallax=0.1, guess=1.0, lens="fixed")
    np.testing.assert_array_equal(result.state.focal, problem.focal)
    assert result.zoom == pytest.approx(1.4, rel=0.01)


def test_a_zoom_through_a_given_lens_is_suspected_where_the_path_leads_to_a_wall():
    """Its tracks fit as well as any: only the depth prior may tell."""
    _, result = polished("static", 1.4, parallax=0.0, guess=1.0, lens="fixed")
    assert result.motion.kind is ShotKind.GENERAL
    assert result.zoom == pytest.approx(1.4, rel=1e-3)
    assert not result_doubts(result, 0.0)
    (doubt,) = result_doubts(replace(result, contradiction=0.06), 0.0)
    assert doubt.startswith("A zoom of 1.40 explains the tracks as well")


def test_frames_between_the_solved_ones_have_the_focal_length_between():
    problem, result = polished("rotation", 1.4, parallax=0.0, max_frames=8)
    assert result.frames == list(range(FRAMES))
    np.testing.assert_allclose(result.state.focal, problem.focal * profile(1.4), rtol=0.01)
    assert 0.03 < np.median(result.errors) < 0.16


@pytest.fixture(scope="module")
def shot():
    return render_shot("handheld", 24, 320, 180, parallax=0.06, zoom=1.4)


@pytest.fixture(scope="module")
def reconstruction(shot):
    options = replace(with_fewer_tracks(Options(), 400), lens="zoom")
    stream = Stream(depth=Maps(simulate_prior(shot)), options=options)
    for image in shot.images:
        stream.push(image)
    return stream.finish()


def test_a_rendered_zoom_is_followed(shot, reconstruction):
    assert len(reconstruction.registered) == 24
    focals = np.array([reconstruction.camera_of(frame).mean_focal_length() for frame in reconstruction.frames])
    course = focals / focals[0]
    assert 5e-4 < np.abs(course / shot.zoom - 1).max() < 0.004
    assert reconstruction.lens.determined
    assert 3e-4 < np.abs(focals / (shot.camera.mean_focal_length() * shot.zoom) - 1).max() < 0.015
    assert 0.01 < reconstruction.lens.focal_std < 0.03
    assert 2e-4 < reconstruction.lens.zoom_std < 1.5e-3
    assert focal_range(reconstruction) == pytest.approx((focals.min(), focals.max()))
    assert any("changes from" in note for note in reconstruction.notes)
    assert 0.015 < errors_of(reconstruction, shot).r_rpe.max() < 0.12


def test_a_zoom_survives_its_files(reconstruction, tmp_path):
    write_folder(reconstruction, tmp_path / "result")
    back = read_result(tmp_path / "result")
    for before, after in zip(reconstruction.frames, back.frames, strict=True):
        np.testing.assert_array_equal(after.camera.params, before.camera.params)
        assert after.focal_std == before.focal_std
    np.testing.assert_allclose(back.camera.params, reconstruction.camera.params)
    np.testing.assert_allclose(
        np.median(back.observation_error), np.median(reconstruction.observation_error), rtol=1e-5
    )
    assert summary(back)["focal_range"] == pytest.approx(summary(reconstruction)["focal_range"])
