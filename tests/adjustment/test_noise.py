"""What the errors of neighbouring tracks have in common."""

import numpy as np
import pytest

from factorsfm.adjustment.noise import block_inflation, shared_sigma


def errors(shared_px, own_px, tracks, frames=32, seed=0):
    """Residuals of tracks that lie evenly in the image; those of a block of it and of time have a part in common."""
    generator = np.random.default_rng(seed)
    place = np.tile(generator.uniform(0, 1, (tracks, 2)), (frames, 1))
    frame = np.repeat(np.arange(frames), tracks)
    cell = (0.999 * (place - place.min(0)) / np.ptp(place, axis=0) * [8, 5]).astype(int)
    block = (frame // 16) * 40 + cell[:, 1] * 8 + cell[:, 0]
    together = shared_px * generator.normal(size=(block.max() + 1, 2))[block]
    return together + own_px * generator.normal(size=(len(frame), 2)), frame, place


@pytest.mark.parametrize("tracks", [200, 800])
def test_the_shared_part_is_measured_however_many_tracks_there_are(tracks):
    assert shared_sigma(*errors(0.05, 0.1, tracks)) == pytest.approx(0.05, rel=0.25)
    assert shared_sigma(*errors(0.0, 0.1, tracks)) < 0.008


def test_the_inflation_grows_with_their_number():
    few, many = (block_inflation(*errors(0.05, 0.1, tracks)) for tracks in (200, 800))
    assert 10.0 < few < 25.0
    assert 3.0 < many / few < 5.0
