"""What a network suspects: it comes back where it agrees with the scene, as a whole and not by chance."""

import numpy as np
import pytest

from factorsfm.adjustment.observations import Observations
from factorsfm.motion.suspects import agreeing

SCENE, FRAMES, NOISE_PX = 200, 20, 0.1


def errors_of_points(*groups, seed=0):
    """Observations of the scene, all over the image, and of further groups; and the lengths of their errors.

    Args:
        groups: points, standard deviation of their errors (pixels), and where they are seen.
    """
    rng = np.random.default_rng(seed)
    places = [rng.uniform([-400, -200], [400, 200], (SCENE, 2))]
    sigmas = [NOISE_PX * np.exp(0.4 * rng.standard_normal(SCENE))]  # some tracks are better than others
    for count, sigma, place in groups:
        places.append(place + rng.uniform(-20, 20, (count, 2)))
        sigmas.append(sigma * np.exp(0.4 * rng.standard_normal(count)))
    pixels, sigma = np.concatenate(places), np.concatenate(sigmas)
    point = np.repeat(np.arange(len(sigma)), FRAMES)
    observations = Observations(np.tile(np.arange(FRAMES), len(sigma)), point, pixels[point])
    errors = np.linalg.norm(sigma[point, None] * rng.standard_normal((len(point), 2)), axis=1)
    return observations, errors, np.arange(len(sigma)) >= SCENE


@pytest.mark.parametrize("seed", range(5))
def test_a_statue_comes_back_and_a_walker_beside_it_does_not(seed):
    statue, walker = (30, NOISE_PX, [-260, 100]), (30, 5 * NOISE_PX, [250, 100])
    observations, errors, suspected = errors_of_points(statue, walker, seed=seed)
    agree = agreeing(observations, errors, suspected)
    assert agree[:SCENE].all()
    assert 0.6 < agree[SCENE : SCENE + 30].mean() < 1.0  # as many as of the scene are within a standard deviation
    assert not agree[SCENE + 30 :].any()


def test_a_few_tracks_of_a_walker_that_fit_by_chance_do_not_come_back():
    observations, errors, suspected = errors_of_points((12, 8 * NOISE_PX, [250, 100]), (4, NOISE_PX, [250, 100]))
    assert not agreeing(observations, errors, suspected)[SCENE:].any()


def test_one_track_alone_does_not_come_back():
    observations, errors, suspected = errors_of_points((1, NOISE_PX, [250, 100]))
    assert not agreeing(observations, errors, suspected)[SCENE:].any()


def test_without_suspects_all_agree_and_without_a_scene_no_suspect_does():
    observations, errors, _ = errors_of_points()
    assert agreeing(observations, errors, np.zeros(SCENE, bool)).all()
    assert not agreeing(observations, errors, np.ones(SCENE, bool)).any()
