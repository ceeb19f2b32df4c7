"""An unknown lens: found where the shot determines it, kept as guessed and called a guess where not."""

from dataclasses import replace

import numpy as np
import pycolmap
import pytest

from factorsfm import api
from factorsfm.adjustment.bundle_adjustment import BundleAdjustment
from factorsfm.adjustment.noise import image_cells
from factorsfm.adjustment.observations import Observations, Sweep
from factorsfm.adjustment.problem import ErrorModel, FocalPrior, Free, Known, LensPrior
from factorsfm.adjustment.residuals import distort, undistort
from factorsfm.adjustment.state import LENS_SIZE
from factorsfm.camera.guess import guess_camera
from factorsfm.camera.projection import PIXEL_CENTER, normalized_from_pixels
from factorsfm.cli.main import main
from factorsfm.lens.camera_model import distortion_of, with_distortion
from factorsfm.lens.certainty import _left_out_covariance, lens_covariances
from factorsfm.lens.lens import Lens, LensEstimate, through
from factorsfm.lens.search import search_lens
from factorsfm.lens.solver import LensSolver
from factorsfm.polish import start
from factorsfm.polish.camera_starts import _everywhere
from factorsfm.polish.polish import polish
from factorsfm.polish.shot import Shot
from factorsfm.result.notes import lens_note
from factorsfm.support.errors import InputError
from factorsfm.support.options import DETERMINED_FOCAL_STD, GIVEN_FOCAL_STD, Options, PolishOptions
from factorsfm.support.status import ShotKind
from tests.estimation_problems import make_problem, mapped_images

BARREL = np.array([-0.15, 0.02, 0.0, 0.0, 0.0, 0.0])
STRONG_BARREL = np.array([-0.3, 0.08, 0.0, 0.0, 0.0, 0.0])


def estimated(problem, *, guess=1.3, shape=None, lens="distortion", first_std=None, solved_lens=None):
    """The polish of a problem whose lens has a shape, from tracks that a guess normalised without it."""
    wrong = np.array([guess * problem.focal])
    start = through(problem.truth, wrong)
    images = mapped_images(seen_through(problem, np.zeros(4) if shape is None else shape), start, guess=guess)
    points = np.arange(len(start.bearing)), start.points
    options = replace(Options.preset_named("geometry"), lens=lens)
    first = None if first_std is None else (wrong, first_std)
    return polish(Shot.of(images, points, wrong, first_focal=first, solved_lens=solved_lens), options)


def seen_through(problem, shape):
    """The problem with distorted observations."""
    pixels = problem.focal * distort(problem.xy, shape)[0]
    return replace(problem, observations=replace(problem.observations, pixels=pixels))


@pytest.mark.parametrize("shape", [None, BARREL, STRONG_BARREL])
def test_what_an_earlier_solve_has_found_is_refined_without_a_search(shape, monkeypatch):
    problem = make_problem("arc", frames=12, points=300, parallax=0.3, noise_px=0.3)
    first = estimated(problem, shape=shape).lens
    assert first.determined
    monkeypatch.setattr(start, "_searched", lambda *arguments: pytest.fail("the lens was searched"))
    again = estimated(problem, shape=shape, solved_lens=first.lens).lens
    assert again.determined
    assert again.lens.bends == first.lens.bends == (shape is not None)
    assert np.log(again.lens.focal / first.lens.focal) == pytest.approx(0.0, abs=0.1 * first.focal_std[0])
    np.testing.assert_allclose(again.focal_std, first.focal_std, rtol=0.02)
    np.testing.assert_allclose(again.lens.shape, first.lens.shape, atol=2e-3)


def assert_derivative(analytic, function, size, step=1e-6):
    for i in range(size):
        d = np.zeros(size)
        d[i] = step
        np.testing.assert_allclose(analytic[..., i], (function(d) - function(-d)) / (2 * step), atol=1e-8)


def test_distortion_derivatives_and_inverse():
    uv = np.random.default_rng(0).uniform(-0.6, 0.6, (50, 2))
    uv[40:] *= 10.0  # some of them beyond the field of view that the polynomial is for
    assert 5 < (np.linalg.norm(uv, axis=1) > 2.0).sum() <= 10
    shape = np.array([-0.15, 0.04, 0.01, -0.02])
    distorted, by_uv, by_lens = distort(uv, shape)
    assert_derivative(by_uv, lambda d: distort(uv + d, shape)[0], 2)
    assert_derivative(by_lens, lambda d: distort(uv, shape + d)[0], 4)
    np.testing.assert_allclose(undistort(distorted[:40], shape), uv[:40], atol=1e-9)


@pytest.mark.parametrize("group", [[0, 0, 0, 0, 0], [1, 0, 2, 2, 1]])
@pytest.mark.parametrize("kernel", [2.0, 1e6])
def test_the_gradient_of_the_lens_columns_is_that_of_the_cost(kernel, group):
    problem = make_problem("handheld", frames=5, points=40, parallax=0.1, noise_px=1.0)
    groups = max(group) + 1
    focal = problem.truth.log_focal + 0.02 * np.arange(groups)
    start = replace(
        problem.truth, lens=np.array([-0.1, 0.05, 0.003, 0.002, 0.1, 0.4]), log_focal=focal, group=np.array(group)
    )  # fmt: skip
    information = np.cov(np.random.default_rng(0).standard_normal((groups, 9))).reshape(groups, groups)
    sigmas = np.array([0.1, 0.1, 0.02, 0.02, 1.0, 1.0])
    options = PolishOptions(kernel=kernel)
    random = np.random.default_rng(1).standard_normal((3, len(problem.observations.pixels), 2))
    observations = replace(problem.observations, sweep=Sweep(20.0 * random[0], 5.0 * random[1], random[2]))
    adjustment = BundleAdjustment(
        start,
        observations,
        options,
        ErrorModel(0.5),
        free=Free(focal=True),
        known=Known(focal=FocalPrior(focal + 0.1, information), lens=LensPrior(start.lens, sigmas)),
    )
    adjustment.state = replace(
        start, lens=start.lens + 0.01, log_focal=start.log_focal + 0.01 * np.arange(1, groups + 1)
    )
    normal = adjustment._linearize()
    lens = 6 * problem.frames
    size = lens + groups + LENS_SIZE
    assert len(normal.camera_gradient) == size

    def slope(column):
        costs = []
        for sign in (1, -1):
            camera = np.zeros(size)
            camera[column] = sign * 1e-6
            costs.append(adjustment._cost(adjustment._retract(camera, np.zeros((len(problem.points), 3)))))
        return (costs[0] - costs[1]) / 2e-6

    expected = np.array([slope(column) for column in range(size)])
    assert (np.abs(expected[lens:]) > 1.0).all()  # every column takes part
    np.testing.assert_allclose(
        normal.camera_gradient, expected, rtol=1e-8, atol=1e-8 * np.abs(expected).max()
    )  # fmt: skip


def test_a_new_focal_length_leaves_the_first_image_as_it_is():
    truth = make_problem("truck", frames=3, points=30).truth
    other = through(truth, np.array([500.0]))
    points = np.arange(len(truth.bearing))
    first = np.zeros_like(points), points
    before, after = (s.camera_points(*first) for s in (truth, other))
    focal = np.exp(truth.log_focal)
    np.testing.assert_allclose(500.0 * after[:, :2] / after[:, 2:], focal * before[:, :2] / before[:, 2:], atol=1e-9)
    np.testing.assert_allclose(other.inverse_distance / after[:, 2], truth.inverse_distance / before[:, 2])


def test_the_lenses_of_several_cameras_are_found():
    problem = make_problem("arc", frames=10, points=200, parallax=0.3, noise_px=0.05)
    groups = np.array([0, 0, 1, 1, 2, 2, 1, 0, 2, 1])
    guess = np.array([1.3, 1.15, 1.4])
    start = through(problem.truth, np.array([1.3 * problem.focal]))
    images = mapped_images(problem, start, guess=guess[groups])
    options = replace(Options.preset_named("geometry"), lens="focal")
    points = np.arange(len(start.bearing)), start.points
    result = polish(Shot.of(images, points, guess * problem.focal, groups=groups), options)
    assert result.lens.determined
    error = np.log(result.lens.lens.focal / problem.focal)
    assert 3e-4 < np.abs(error).max() < 2e-3
    assert (np.abs(error) < 2 * result.lens.focal_std).all()
    np.testing.assert_array_equal(result.state.group, groups)


@pytest.mark.parametrize("guess", [0.6, 2.0])
def test_the_focal_length_is_found_from_a_wrong_guess(guess):
    problem = make_problem("arc", frames=8, points=200, parallax=0.3, noise_px=0.05)
    result = estimated(problem, guess=guess)
    error = result.lens.lens.focal[0] / problem.focal - 1
    assert result.lens.determined
    assert 3e-4 < abs(error) < 2e-3
    assert 1e-3 < result.lens.focal_std < 6e-3 < DETERMINED_FOCAL_STD
    assert not result.lens.lens.shape.any()


def test_a_rotation_determines_the_focal_length():
    result = estimated(make_problem("rotation", frames=8, points=200, parallax=0.0, noise_px=0.1))
    assert result.motion.kind is ShotKind.ROTATION
    assert result.lens.determined
    assert result.lens.lens.focal == pytest.approx(make_problem("rotation").focal, rel=0.01)


def test_the_standard_deviation_is_consistent_with_the_error():
    results = []
    for seed in range(6):
        problem = make_problem("arc", frames=6, points=150, parallax=0.3, noise_px=0.05, seed=seed)
        found = estimated(problem, guess=1.2, lens="focal").lens
        assert found.determined
        results.append(np.log(found.lens.focal[0] / problem.focal) / found.focal_std[0])
    assert 0.4 < np.sqrt(np.mean(np.square(results))) < 1.0


def test_a_distortion_that_is_not_believed_makes_the_focal_length_less_certain():
    """Too small to be told from errors of tracks, it moves the focal length by more than the tracks' noise does."""
    off = {}
    for lens in ("focal", "distortion"):
        off[lens] = []
        for seed in range(3):
            problem = make_problem("arc", frames=6, points=150, parallax=0.3, noise_px=0.05, seed=seed)
            found = estimated(problem, guess=1.2, shape=np.array([-0.02, 0.0, 0.0, 0.0]), lens=lens).lens
            assert not found.lens.shape.any()
            off[lens].append(np.log(found.lens.focal[0] / problem.focal) / found.focal_std[0])
    conditional, joint = (np.sqrt(np.mean(np.square(off[lens]))) for lens in ("focal", "distortion"))
    assert 0.5 < joint < 1.2
    assert conditional > 1.3 * joint


def test_errors_as_long_as_a_track_lives_count_once():
    """Tracks that slide away, each at a speed of its own, say less than their many observations promise."""
    off = []
    for seed in range(6):
        problem = make_problem("arc", frames=24, points=120, parallax=0.3, noise_px=0.02, seed=seed)
        o = problem.observations
        speed = 0.3 * np.random.default_rng(seed).standard_normal((len(problem.points), 2))
        slid = o.pixels + speed[o.point] * (o.frame / problem.frames)[:, None]
        solver = LensSolver(replace(o, pixels=slid), PolishOptions(tolerance=1e-6))
        adjustment = solver.solved(problem.truth, 0.1, np.zeros(LENS_SIZE))
        std = np.sqrt(max(c[0, 0] for c in lens_covariances(adjustment)))
        off.append((adjustment.state.log_focal[0] - np.log(problem.focal)) / std)
    assert 0.35 < np.sqrt(np.mean(np.square(off))) < 0.9


def test_what_is_left_out_tells_as_much_as_independent_errors_do():
    errors, said = [], []
    for seed in range(6):
        problem = make_problem("arc", frames=9, points=150, parallax=0.3, noise_px=0.2, seed=seed)
        solver = LensSolver(problem.observations, PolishOptions(tolerance=1e-6))
        solved = solver.solved(problem.truth, 0.2, np.zeros(LENS_SIZE))
        errors.append(solved.state.log_focal[0] - np.log(problem.focal))
        said.append(np.sqrt(_left_out_covariance(solved)[0, 0] / lens_covariances(solved)[0][0, 0]))
    assert 0.8 < np.median(said) < 1.4


def test_what_is_left_out_shows_that_parts_of_the_shot_disagree():
    """A third of the time in a part of the image, all tracks are off by the same: their residuals hardly show it."""
    off = {"within": [], "left out": []}
    for seed in range(6):
        problem = make_problem("arc", frames=9, points=150, parallax=0.3, noise_px=0.02, seed=seed)
        o = problem.observations
        part = image_cells(o.pixels, 3, 2) + 6 * (o.frame // 3)
        shift = 0.5 * np.random.default_rng(seed).standard_normal((18, 2))
        solver = LensSolver(replace(o, pixels=o.pixels + shift[part]), PolishOptions(tolerance=1e-6))
        solved = solver.solved(problem.truth, 0.3, np.zeros(LENS_SIZE))
        error = solved.state.log_focal[0] - np.log(problem.focal)
        off["within"].append(error / np.sqrt(max(c[0, 0] for c in lens_covariances(solved))))
        off["left out"].append(error / np.sqrt(_left_out_covariance(solved)[0, 0]))
    within, left_out = (np.sqrt(np.mean(np.square(off[key]))) for key in ("within", "left out"))
    assert 0.6 < left_out < 1.6
    assert within > 3.0 * left_out


def test_the_tracks_of_an_unknown_lens_show_all_parts_of_the_image():
    """Long tracks in the middle, short ones at the rim: of both, the longest in their part."""
    grid = np.stack(np.meshgrid(np.linspace(-1, 1, 9), np.linspace(-1, 1, 6)), -1).reshape(-1, 2)
    length = np.where(np.abs(grid).max(1) > 0.7, 4, 40)
    place, length = np.repeat(grid, 3, axis=0), np.repeat(length, 3) + np.tile([0, 1, 2], len(grid))
    point = np.repeat(np.arange(len(place)), length)
    frame = np.concatenate([np.arange(n) for n in length])
    chosen = _everywhere(Observations(frame, point, place[point]), 2)
    cells = image_cells(place, 8, 5)
    for cell in np.unique(cells):
        mine = np.flatnonzero(cells == cell)
        best = mine[np.argsort(-length[mine], kind="stable")[:2]]
        np.testing.assert_array_equal(np.sort(length[np.intersect1d(chosen, mine)]), np.sort(length[best]))


@pytest.mark.parametrize(("motion", "parallax"), [("truck", 0.004), ("dolly", 0.2)])
def test_tiny_motion_or_none_but_along_the_view_axis_keeps_the_guess(motion, parallax):
    problem = make_problem(motion, frames=8, points=150, parallax=parallax, noise_px=0.2)
    result = estimated(problem, guess=1.2, first_std=0.3)
    assert not result.lens.determined
    assert not result.lens.rough
    assert np.exp(result.state.log_focal) == pytest.approx(1.2 * problem.focal)
    assert result.lens.focal_std > 0.4 > DETERMINED_FOCAL_STD


@pytest.mark.parametrize("first_std", [0.02, 0.06, 0.3])
def test_a_focal_length_that_is_not_determined_is_the_mean_of_guess_and_estimate(first_std):
    problem = make_problem("arc", frames=8, points=150, parallax=0.1, noise_px=0.1, seed=3)
    alone = estimated(problem, guess=1.2, lens="focal", first_std=10.0).lens
    assert alone.rough
    assert not alone.determined
    assert 0.02 < alone.focal_std < GIVEN_FOCAL_STD
    found = np.log(alone.lens.focal[0] / problem.focal)
    result = estimated(problem, guess=1.2, lens="focal", first_std=first_std)
    assert result.lens.rough == (alone.focal_std < first_std)
    weights = np.array([alone.focal_std[0], first_std]) ** -2.0 if result.lens.rough else np.array([0.0, 1.0])
    expected = weights @ [found, np.log(1.2)] / weights.sum()
    assert np.log(np.exp(result.state.log_focal) / problem.focal) == pytest.approx(expected, abs=2e-3)
    assert result.sigma < 0.25


@pytest.mark.parametrize(("motion", "parallax"), [("rotation", 0.0), ("arc", 0.3)])
def test_a_translation_that_is_none_does_not_bend_with_the_lens(motion, parallax):
    problem = make_problem(motion, frames=8, points=150, parallax=parallax, noise_px=0.05)
    solver = LensSolver(seen_through(problem, BARREL).observations, PolishOptions(tolerance=1e-5))
    bent = replace(problem.truth, translation=problem.truth.translation + 0.01 * np.eye(8, 3))
    start = replace(bent, translation=bent.translation - bent.translation[0])
    solved, moves = solver.solved_as_it_moves(start, 0.05, np.array([0.1, 0.1, 0.0, 0.0, 0.0, 0.0]))
    assert moves == (motion == "arc")
    assert solved.state.translation.any() == moves
    np.testing.assert_allclose(solved.state.lens, BARREL, atol=0.004)
    assert np.exp(solved.state.log_focal) == pytest.approx(problem.focal, rel=0.01)


def test_tracks_that_fit_no_lens_determine_none():
    problem = make_problem("arc", frames=16, points=400, parallax=0.3, noise_px=0.8)
    result = estimated(problem, guess=1.2, lens="focal")
    assert not result.lens.determined
    assert 0.6 < result.lens.misfit_px < 1.0
    assert np.exp(result.state.log_focal) == pytest.approx(1.2 * problem.focal)


@pytest.mark.parametrize("lens", ["distortion", "all"])
def test_distortion_is_recovered_over_the_image(lens):
    problem = make_problem("arc", frames=8, points=250, parallax=0.3, noise_px=0.03)
    shape = BARREL if lens == "distortion" else BARREL + [0, 0, 0.01, -0.008, 0, 0]
    found = estimated(problem, guess=1.2, shape=shape, lens=lens).lens
    assert found.determined
    assert 1e-3 < found.shape_std[:2].max() < 0.012
    xy = problem.xy
    truth = problem.focal * distort(xy, shape)[0]
    off = np.linalg.norm(found.lens.focal * distort(xy, found.lens.shape)[0] - truth, axis=1)
    assert 0.2 < np.percentile(off, 99) < (0.5 if lens == "distortion" else 1.5)


@pytest.mark.parametrize("guess", [0.8, 1.3])
@pytest.mark.parametrize(("motion", "parallax"), [("rotation", 0.0), ("arc", 0.3)])
def test_strong_distortion_is_found_with_the_focal_length(motion, parallax, guess):
    problem = make_problem(motion, frames=10, points=200, parallax=parallax, noise_px=0.05)
    result = estimated(problem, guess=guess, shape=STRONG_BARREL)
    assert (result.motion.kind is ShotKind.ROTATION) == (motion == "rotation")
    assert result.lens.determined
    error = np.log(result.lens.lens.focal[0] / problem.focal)
    assert 5e-4 < abs(error) < min(0.005, 3 * result.lens.focal_std[0])
    np.testing.assert_allclose(result.lens.lens.shape, STRONG_BARREL, atol=0.02)


def test_the_search_sees_through_distortion_where_it_may():
    """Without distortion, the best focal length is one with which the tracks do not fit."""
    problem = make_problem("arc", frames=10, points=200, parallax=0.1, noise_px=0.05)
    seen = seen_through(problem, STRONG_BARREL).observations
    adjustment = BundleAdjustment(problem.truth, seen, PolishOptions(), ErrorModel(0.2))
    straight, cost = search_lens(adjustment, PolishOptions())
    bent, bent_cost = search_lens(adjustment, PolishOptions(), np.array([0.1, 0.1, 0.0, 0.0, 0.0, 0.0]))
    assert not straight.lens.any()
    assert bent_cost < 0.5 * cost
    assert bent.focal[0] == pytest.approx(problem.focal, rel=0.1)
    np.testing.assert_allclose(bent.lens, STRONG_BARREL, atol=0.1)


def test_distortion_alone_is_recovered_and_the_focal_length_stays_as_given():
    problem = make_problem("truck", frames=8, points=250, parallax=0.05, noise_px=0.03)
    result = estimated(problem, guess=1.0, shape=BARREL, lens="radial")
    found = result.lens
    assert found.determined
    assert not found.focal_std.any()
    assert found.lens.focal == pytest.approx(problem.focal, rel=1e-6)
    assert lens_note(found).startswith("The focal length is as it was given; radial distortion k1 -0.1")
    xy = problem.xy
    off = problem.focal * np.linalg.norm(distort(xy, found.lens.shape)[0] - distort(xy, BARREL)[0], axis=1)
    assert 0.1 < np.percentile(off, 99) < 0.3
    straight = estimated(problem, guess=1.0, lens="radial").lens
    assert lens_note(straight) == "The focal length is as it was given; no distortion was found."
    assert not straight.lens.shape.any()


def test_a_camera_of_the_lens_sees_as_the_lens_does():
    guess = guess_camera(960, 540)
    shape = np.array([-0.1, 0.03, 0.01, -0.02])
    camera = with_distortion(guess, 800.0, shape)
    assert camera.model_name == "RADIAL"
    uv = np.array([[0.1, 0.2], [-0.4, 0.15]])
    pixels = 800.0 * distort(uv, shape)[0] + [480 - PIXEL_CENTER, 270 - PIXEL_CENTER]
    np.testing.assert_allclose(normalized_from_pixels(camera, pixels), uv, atol=1e-8)
    np.testing.assert_allclose(distortion_of(camera), [-0.1, 0.03, 0, 0])


def test_a_lens_that_cannot_be_estimated_is_refused():
    fisheye = pycolmap.Camera(
        camera_id=1, model="OPENCV_FISHEYE", width=64, height=64, params=[50, 50, 32, 32, 0, 0, 0, 0]
    )
    with pytest.raises(InputError, match="OPENCV_FISHEYE"):
        distortion_of(fisheye)
    with pytest.raises(InputError, match="unknown lens 'wide'"):
        api.reconstruct([], lens="wide")


def test_the_command_line_takes_what_is_free(capsys):
    with pytest.raises(SystemExit):
        main(["reconstruct", "shot.mp4", "--output", "out", "--lens", "wide"])
    assert "--lens" in capsys.readouterr().err


def test_a_match_that_is_seen_far_outside_of_the_image_says_nothing_of_the_distortion():
    """A point that the camera has passed by: a wrong match puts it into the last image all the same."""
    problem = make_problem("dolly", frames=6, points=300, parallax=0.3, noise_px=0.01)
    truth, o, n = problem.truth, problem.observations, len(problem.points)
    rotation, translation = truth.rotation[-1], truth.translation[-1]
    beside = rotation.T @ (np.array([0.05, 0.0, 1e-4]) - translation)
    q = (truth.rotation @ beside + truth.translation)[:3]
    seen = np.concatenate([q[:, :2] / q[:, 2:], [[0.1, -0.05]]])
    assert np.abs(seen).max() < 0.5
    observations = Observations(
        np.append(o.frame, [0, 1, 2, 5]),
        np.append(o.point, np.full(4, n)),
        np.concatenate([o.pixels, problem.focal * seen]),
    )
    start = replace(
        truth,
        bearing=np.concatenate([truth.bearing, beside[None] / np.linalg.norm(beside)]),
        inverse_distance=np.append(truth.inverse_distance, 1.0 / np.linalg.norm(beside)),
    )
    known = Known(lens=LensPrior(np.zeros(6), np.array([0.1, 0.1, 0.0, 0.0, 0.0, 0.0])))
    found = []
    for state, some in ((truth, o), (start, observations)):
        adjustment = BundleAdjustment(
            state, some, PolishOptions(), ErrorModel(0.01), free=Free(focal=True), known=known
        )
        found.append((adjustment.solve().lens[:2], np.sqrt(adjustment.marginals().camera.diagonal())))
    (without, std), (beside_it, other_std) = found
    std, other_std = (s[adjustment.columns.lens][:2] for s in (std, other_std))
    assert ((other_std / std > 0.7) & (other_std / std < 2.0)).all()
    assert (np.abs(beside_it - without) < 2.0 * std).all()


@pytest.mark.parametrize(("first_std", "contradicted"), [(0.03, True), (0.3, False)])
def test_a_focal_length_of_exif_data_that_the_images_contradict_is_told(first_std, contradicted):
    problem = make_problem("arc", frames=10, points=200, parallax=0.3, noise_px=0.05)
    result = estimated(problem, guess=1.25, first_std=first_std, lens="focal")
    assert result.lens.lens.focal[0] == pytest.approx(problem.focal, rel=0.002)
    assert result.lens.contradicted_px == pytest.approx(1.25 * problem.focal if contradicted else 0.0)
    assert ("which the images contradict" in lens_note(result.lens)) == contradicted


def test_a_deviation_without_meaning_has_no_digits():
    lens = Lens(np.array([900.0]))
    wild = LensEstimate(lens, np.array([2749.9]), np.full(6, np.nan), misfit_px=0.0, determined=False)
    assert lens_note(wild).endswith("this shot does not determine it (standard deviation of more than 100 %).")
