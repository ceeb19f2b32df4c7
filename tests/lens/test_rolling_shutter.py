"""A rolling shutter: found where the tracks show one, taken out of lens and points, not seen where there is none."""

import json
from dataclasses import asdict, replace
from functools import cache

import numpy as np
import pytest

from factorsfm import Frame, reconstruct
from factorsfm.adjustment.bundle_adjustment import BundleAdjustment
from factorsfm.adjustment.observations import Observations
from factorsfm.adjustment.problem import ErrorModel
from factorsfm.adjustment.state import LENS_SIZE, State
from factorsfm.lens.lens import Lens, through
from factorsfm.lens.rolling_shutter import Recording, Shutter, seen_at_once, with_sweep
from factorsfm.mapping.mapped_images import MappedImage
from factorsfm.polish.polish import polish
from factorsfm.polish.shot import Shot
from factorsfm.report.result_folder import write_folder
from factorsfm.result.assembly import _rolling_shutter
from factorsfm.result.notes import shutter_note
from factorsfm.support.errors import InputError
from factorsfm.support.options import Options, PolishOptions
from factorsfm.support.status import FrameStatus, ShotKind
from factorsfm.synthetic import read_by_rows, render_shot
from tests.estimation_problems import angles_between, make_problem, mapped_images, rotation_matrices, tracks_at
from tests.rendered import errors_of

WIDTH, HEIGHT = 640, 360
STEPS = 8  # of the path between two frames


def rolling_problem(motion, readout, *, frames=48, parallax=0.1, points=160, noise_px=0.1, along="rows", seed=1):
    """A problem whose observations are those of a rolling shutter; its poses are of the middle of the image."""
    dense = make_problem(motion, frames=STEPS * (frames + 1) + 1, points=points, parallax=parallax)
    kept = STEPS * (np.arange(frames) + 1)
    count = len(dense.points)
    xy = dense.xy.reshape(count, dense.frames, 2)
    axis = {"rows": 1, "columns": 0}[along]
    seen = xy[:, kept]
    for _ in range(20):  # what is seen depends on when it is seen, and when on where
        time = np.clip(
            kept + STEPS * readout * dense.focal * seen[..., axis] / (WIDTH, HEIGHT)[axis], 0, dense.frames - 1.001
        )
        before = time.astype(int)
        share = (time - before)[..., None]
        row = np.arange(count)[:, None]
        seen = (1 - share) * xy[row, before] + share * xy[row, before + 1]
    noise = noise_px / dense.focal * np.random.default_rng(seed).standard_normal(seen.shape)
    truth = replace(
        dense.truth, rotation=dense.truth.rotation[kept], translation=dense.truth.translation[kept],
        group=np.zeros(frames, np.int64), world=-1,
    ).seen_from(0)  # fmt: skip
    frame, point = np.tile(np.arange(frames), count), np.repeat(np.arange(count), frames)
    observations = Observations(frame, point, dense.focal * (seen + noise).reshape(-1, 2))
    return replace(dense, truth=truth, points=truth.points, observations=observations, noise_px=noise_px)


def polished(problem, *, shutter="rolling", lens="fixed", guess=1.0, **options):
    focal = guess * np.exp(problem.truth.log_focal)
    start = through(problem.truth, focal)
    images = mapped_images(problem, start, guess=guess)
    known = replace(Options.preset_named("geometry"), lens=lens, shutter=shutter)
    known = replace(known, polish=replace(known.polish, **options))
    points = np.arange(len(start.bearing)), start.points
    recording = Recording(WIDTH, HEIGHT, np.arange(len(images)))
    return polish(Shot.of(images, points, focal, recording=recording if shutter != "global" else None), known)


def wrong_by(found, problem):
    """Root mean squares of the rotations' errors (degrees) and the centres' (of the path's extent)."""
    truth, state = problem.truth, found.state
    truth_centers, centers = (-np.einsum("kji,kj->ki", s.rotation, s.translation) for s in (truth, state))
    scale = (truth_centers * centers).sum() / max((centers**2).sum(), 1e-30)
    away = np.linalg.norm(scale * centers - truth_centers, axis=1) / max(np.ptp(truth_centers, axis=0).max(), 1e-12)
    angles = np.degrees(angles_between(state.rotation, truth.rotation))
    return float(np.sqrt(np.mean(angles**2))), float(np.sqrt(np.mean(away**2)))


@cache
def handheld():
    return rolling_problem("handheld", 0.9)


@cache
def handheld_polished(shutter):
    return polished(handheld(), shutter=shutter)


@pytest.mark.parametrize(("readout", "along"), [(0.9, "rows"), (0.3, "columns"), (-0.6, "rows")])
def test_the_readout_is_found_and_poses_are_those_of_the_middle(readout, along):
    if (readout, along) == (0.9, "rows"):
        problem, found, ignored = handheld(), handheld_polished("rolling"), handheld_polished("global")
    else:
        problem = rolling_problem("handheld", readout, along=along)
        found, ignored = polished(problem), polished(problem, shutter="global")
    index = {"columns": 0, "rows": 1}[along]
    assert found.shutter is not None
    assert found.shutter.readout[index] == pytest.approx(readout, abs=max(0.01, 3 * found.shutter.std))
    assert found.shutter.readout[1 - index] == 0.0
    assert 0.002 < found.shutter.std < 0.015
    assert 0.8 < found.sigma / problem.noise_px < 1.2
    angle, away = wrong_by(found, problem)
    ignored_angle, ignored_away = wrong_by(ignored, problem)
    assert angle < 0.02
    assert away < 0.01
    assert ignored.shutter is None
    assert ignored_angle > 3 * angle
    assert ignored_away > 3 * away


@pytest.mark.parametrize("motion", ["handheld", "dolly", "truck", "arc", "rotation", "static"])
def test_no_rolling_shutter_is_found_where_there_is_none(motion):
    found = polished(rolling_problem(motion, 0.0, noise_px=0.2), shutter="auto")
    assert found.shutter is None
    assert not found.recorded


def test_without_a_shutter_the_result_is_that_of_not_looking_for_one():
    problem = rolling_problem("handheld", 0.0)
    looked, not_looked = polished(problem), polished(problem, shutter="global")
    np.testing.assert_array_equal(looked.state.rotation, not_looked.state.rotation)
    np.testing.assert_array_equal(looked.state.translation, not_looked.state.translation)


def test_an_unknown_focal_length_is_found_beside_the_readout():
    problem = rolling_problem("handheld", 0.9, parallax=0.2)
    found = polished(problem, lens="focal", guess=1.2)
    assert found.lens is not None
    assert found.lens.determined
    assert found.lens.lens.focal[0] == pytest.approx(problem.focal, rel=max(0.003, 3 * found.lens.focal_std[0]))
    assert found.lens.focal_std[0] < 0.01
    assert found.shutter.readout[1] == pytest.approx(0.9, abs=max(0.01, 3 * found.shutter.std))
    ignored = polished(problem, lens="focal", guess=1.2, shutter="global").lens
    off = abs(ignored.lens.focal[0] / problem.focal - 1)
    assert off > 0.1


def test_poses_of_the_recorded_images_show_the_points_where_the_images_do():
    problem, rolling, recorded = handheld(), handheld_polished("rolling"), handheld_polished("auto")
    assert recorded.recorded
    assert not rolling.recorded
    np.testing.assert_allclose(recorded.state.rotation[0], np.eye(3), atol=1e-12)
    np.testing.assert_allclose(recorded.state.translation[0], 0.0, atol=1e-12)
    rows = np.isin(problem.observations.point, recorded.tracks)
    np.testing.assert_allclose(recorded.observations.pixels, problem.observations.pixels[rows], atol=1e-9)
    assert not recorded.state.lens.any()
    still = replace(rolling.state, lens=np.zeros(LENS_SIZE))
    shown = BundleAdjustment(still, recorded.observations, PolishOptions(), ErrorModel(1.0)).reprojection_errors()
    assert 0.5 < np.sqrt(np.mean(recorded.errors**2) / np.mean(shown**2)) < 0.95
    # No camera without a rolling shutter shows all points there, and this one shows them better than any near it.
    for axis in range(6):
        for sign in (-1, 1):
            nudge = np.zeros(6)
            nudge[axis] = sign * 2e-4
            turn = np.eye(3) + np.cross(np.eye(3), nudge[:3])
            state = replace(
                recorded.state,
                rotation=turn @ recorded.state.rotation,
                translation=np.einsum("ij,kj->ki", turn, recorded.state.translation) + nudge[3:],
            )
            other = BundleAdjustment(
                state, recorded.observations, PolishOptions(), ErrorModel(1.0)
            ).reprojection_errors()
            assert (other**2).sum() > (recorded.errors**2).sum()


def test_cameras_of_the_recorded_images_are_exact_where_the_shutter_is_not_rolling():
    problem = make_problem("arc", frames=6, points=60, parallax=0.2)
    turned = rotation_matrices([0.0, 0.0, 0.01]) @ problem.truth.rotation
    start = replace(problem.truth, translation=problem.truth.translation + 0.01, rotation=turned)
    found = seen_at_once(start, problem.observations, np.ones(len(problem.observations.pixels)), moves=True)
    np.testing.assert_allclose(found.rotation, problem.truth.rotation, atol=1e-9)
    np.testing.assert_allclose(found.translation, problem.truth.translation, atol=1e-9)


def test_frames_between_are_of_the_same_moment_as_the_others():
    problem = handheld()
    few = polished(problem, max_frames=20)
    assert few.frames == list(range(48))
    assert few.shutter.readout[1] == pytest.approx(0.9, abs=0.008)
    assert wrong_by(few, problem)[0] < 0.03
    recorded = polished(problem, max_frames=20, shutter="auto")
    exact = handheld_polished("auto")
    assert np.degrees(angles_between(recorded.state.rotation, exact.state.rotation)).max() < 0.05


def test_motion_is_seen_in_the_images_before_and_after():
    """Tracks that move on evenly but for the acceleration of all, and one of a single image."""
    rng = np.random.default_rng(3)
    x, motion = rng.uniform(-0.4, 0.4, (31, 2)), rng.uniform(-0.01, 0.01, (31, 2))
    acceleration = np.array([0.004, -0.002]) + x @ np.array([[0.001, 0.002], [0.0, -0.003]])
    images, times = [], np.array([0, 2, 3])  # an image is missing
    for position, ids in enumerate((np.arange(0, 25), np.arange(0, 31), np.arange(5, 30))):
        time = times[position] - 2
        xy = x[ids] + motion[ids] * time + 0.5 * acceleration[ids] * time**2
        images.append(MappedImage(tracks_at(position, ids, xy), FrameStatus.REGISTERED, ""))
    o = Observations(np.zeros(31, np.int64), np.arange(31), 100.0 * x)
    sweep = with_sweep(o, np.arange(31), images, [1], np.array([100.0]), Recording(200, 50, times)).sweep
    np.testing.assert_allclose(sweep.motion[:30], 100.0 * motion[:30], atol=1e-9)
    np.testing.assert_allclose(sweep.acceleration[:30], 100.0 * acceleration[:30], atol=1e-9)
    np.testing.assert_allclose(sweep.place, 100.0 * x / [200.0, 50.0], atol=1e-12)
    assert sweep.motion[30].tolist() == sweep.acceleration[30].tolist() == [0.0, 0.0]
    assert o.at(np.array([0, 2])).sweep is None


def test_no_sensor_reads_longer_than_until_the_next_frame():
    assert polished(rolling_problem("handheld", 0.99)).shutter is not None
    assert polished(rolling_problem("handheld", 1.3)).shutter is None


def test_a_readout_that_grows_too_long_beside_an_unknown_lens_is_none(monkeypatch):
    """As if the first look had taken 1.3 for less; all is then as without a shutter."""
    problem = rolling_problem("handheld", 1.3, parallax=0.2)
    ignored = polished(problem, lens="focal", guess=1.2, shutter="global")
    shape = np.zeros(LENS_SIZE)
    shape[-1] = 0.9
    guess = Shutter(Lens(np.array([1.2 * problem.focal]), shape), 0.02)
    monkeypatch.setattr("factorsfm.polish.start.find_shutter", lambda *_: guess)
    found = polished(problem, lens="focal", guess=1.2)
    assert found.shutter is None
    assert found.lens.lens.focal == pytest.approx(ignored.lens.lens.focal, rel=1e-6)
    np.testing.assert_array_equal(found.state.lens, ignored.state.lens)


def test_errors_of_the_tracks_are_no_readout():
    """A truck does not show its readout: what the errors seem to say of one must not count."""
    for seed in range(2):
        problem = rolling_problem("truck", 0.9, frames=24, noise_px=0.3, seed=seed)
        assert polished(problem).shutter is None


@pytest.mark.parametrize(("lens", "guess", "focals"), [("fixed", 1.0, 0), ("focal", 1.2, 1)])
def test_a_camera_that_turns_does_not_seem_to_move(lens, guess, focals):
    problem = rolling_problem("rotation", 0.9)
    found = polished(problem, lens=lens, guess=guess)
    recorded = polished(problem, shutter="auto")
    assert polished(problem, shutter="global").motion.kind is ShotKind.GENERAL
    for result in (found, recorded):
        assert result.motion.kind is ShotKind.ROTATION
        assert not result.state.translation.any()
        assert result.shutter.readout[1] == pytest.approx(0.9, abs=0.03)
    assert 0.002 < wrong_by(found, problem)[0] < 0.01
    estimated = [] if found.lens is None else found.lens.lens.focal.tolist()
    assert estimated == pytest.approx(focals * [problem.focal], rel=1e-3)  # other seeds: 3.4e-4, root mean square


@pytest.mark.parametrize(
    ("readout", "order"), [([0.0, 0.9], "top to bottom"), ([0.0, -0.9], "bottom to top"), ([0.4, 0.0], "left to right")]
)
def test_the_note_says_how_images_are_read(readout, order):
    found = handheld_polished("rolling")
    shutter = replace(found.shutter, lens=Lens(found.shutter.lens.focal, np.r_[np.zeros(4), readout]), std=0.021)
    said = _rolling_shutter(replace(found, shutter=shutter))
    note = shutter_note(said, 1 / 25)
    assert f"from {order} in {abs(said.readout):.2f} ± 0.02" in note
    assert f"({40 * abs(said.readout):.1f} ms)" in note
    assert "ms" not in shutter_note(said, 0.0)


def test_a_world_that_is_no_camera_can_be_left():
    state = make_problem("arc", frames=3, points=5).truth
    moved = replace(state.seen_from(2), world=-1).seen_from(0)
    np.testing.assert_allclose(moved.translation, state.translation, atol=1e-12)
    assert isinstance(moved, State)
    assert moved.world == 0


@cache
def rolling_shot():
    return render_shot("handheld", 16, 320, 180, parallax=0.05, readout=0.8)


def test_rows_are_seen_from_where_the_camera_is_at_their_time():
    still = render_shot("rotation", 5, 320, 180)
    image = read_by_rows(still.images[2], still.depths[2], still.camera, still.cam_from_world, 2, 1.0)
    finer = render_shot("rotation", 9, 320, 180)  # half a frame before and after the pose
    for row, frame in ((0, 3), (89, 4), (179, 5)):
        read, unread, true = (i[row].astype(float) for i in (image, still.images[2], finer.images[frame]))
        away, unmoved = (np.abs(seen - true)[40:-40].mean() for seen in (read, unread))
        assert away < (1.0 if row == 89 else 0.35 * unmoved)


def test_a_rendered_rolling_shutter_is_found_and_reported(tmp_path):
    shot = rolling_shot()
    frames = [Frame(index=i, name=f"{i:06d}", image=image, timestamp=i / 25) for i, image in enumerate(shot.images)]
    found = {
        use: reconstruct(frames, camera=shot.camera, depth=None, shutter=use) for use in ("global", "auto", "rolling")
    }
    for use in ("auto", "rolling"):
        fit = found[use].shutter
        assert fit.readout == pytest.approx(0.8, abs=max(0.02, 3 * fit.std))
        assert (fit.along, fit.recorded) == ("rows", use == "auto")
    assert found["global"].shutter is None
    away = {use: np.median(errors_of(result, shot).ate) for use, result in found.items()}
    assert away["rolling"] < 0.1 * away["global"]
    assert away["rolling"] < 0.003  # of the path
    (note,) = (note for note in found["auto"].notes if "Rolling shutter" in note)
    assert "from top to bottom in 0.8" in note
    assert "poses fit the recorded images" in note
    write_folder(found["auto"], tmp_path / "result")
    said = json.loads((tmp_path / "result" / "summary.json").read_text())["shutter"]
    assert said == asdict(found["auto"].shutter)


def test_an_unknown_use_of_the_shutter_is_refused():
    with pytest.raises(InputError, match="unknown shutter 'curtain', expected one of auto, global, rolling"):
        reconstruct([], shutter="curtain")
