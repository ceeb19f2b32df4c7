"""Times of frames, and the rhythm of those that repeat."""

import cv2
import numpy as np
import pytest

from factorsfm.frames.reading import read_frames
from factorsfm.frames.repeats import RepeatDetector
from factorsfm.frames.timing import Pace, are_uneven, cadence, frame_interval, frame_times
from factorsfm.support.pace import frames_in
from factorsfm.synthetic import render_shot
from tests.video_files import moving_texture, write_video


def test_even_times_are_the_indices_though_containers_round_them():
    index = list(range(3, 60, 2))
    stamps = [round(k / 24, 3) for k in index]
    assert frame_times(index, stamps).tolist() == index
    assert frame_interval(index, stamps) == pytest.approx(1 / 24, abs=5e-4)
    assert not are_uneven(index, stamps)


def test_uneven_times_count_in_usual_intervals():
    """24 frames a second, of which every other one is left out in the second half."""
    stamps = [k / 24 for k in (0, 1, 2, 3, 4, 5, 7, 9, 11)]
    times = frame_times(range(9), stamps)
    assert times == pytest.approx([0, 1, 2, 3, 4, 5, 7, 9, 11])
    assert are_uneven(range(9), stamps)
    assert frame_interval(range(9), stamps) == pytest.approx(1 / 24)


@pytest.mark.parametrize("stamps", [[None] * 4, [0.0, 0.1, None, 0.3], [0.0, 0.1, 0.1, 0.1], [3.0, 2.0, 1.0, 0.0]])
def test_times_that_are_unknown_or_do_not_rise_are_no_times(stamps):
    assert frame_times([0, 1, 2, 3], stamps).tolist() == [0, 1, 2, 3]


@pytest.mark.parametrize(
    ("pattern", "period", "new"),
    [
        *[("nnnnr", 5, 4), ("nr", 2, 1), ("nnr", 3, 2), ("nrnrr", 5, 2), ("nrr", 3, 1)],
        *[("nnnnnr", 6, 5), ("nrnrnrrnrnrr", 12, 5)],
    ],
)
def test_a_cadence_is_found_though_a_repeat_is_missed(pattern, period, new):
    flags = np.resize(np.array([c == "r" for c in pattern]), 60)
    assert cadence(flags.tolist()) == (period, new)
    flags[int(np.flatnonzero(flags)[0])] = False
    assert cadence(flags.tolist()) == (period, new)


def test_dropped_frames_have_no_cadence():
    flags = np.zeros(100, bool)
    flags[[7, 20, 22, 51, 83]] = True
    assert cadence(flags.tolist()) is None
    assert cadence([False] * 50) is None


@pytest.mark.parametrize("keyframes", [8, 12])
def test_one_frame_from_keyframe_to_keyframe_is_no_cadence(keyframes):
    assert cadence([k % keyframes == 1 for k in range(100)]) is None
    assert cadence([k % keyframes in (1, 2) for k in range(100)]) == (keyframes, keyframes - 2)


def grainy(images):
    """Sensor noise of 2 grey levels, new in each image."""
    rng = np.random.default_rng(1)
    return [np.clip(image[:, :, 0] + rng.normal(0, 2, image.shape[:2]), 0, 255).astype(np.uint8) for image in images]


@pytest.mark.parametrize("step", [0.0, 0.2, 3.0])
def test_repeats_are_told_from_new_frames(step):
    images = grainy(moving_texture(40, step))
    rng = np.random.default_rng(2)
    shown = [k for k in range(40) for _ in range(2 if k % 4 == 3 else 1)]
    detector, found = RepeatDetector(), []
    for k, number in enumerate(shown):
        compressed = images[number].astype(np.int16) + rng.integers(-1, 2, images[number].shape) * (k % 2) * (step > 0)
        found.append(detector.push(np.clip(compressed, 0, 255).astype(np.uint8) if step > 1 else images[number]))
    expected = [k > 0 and shown[k] == shown[k - 1] for k in range(len(shown))]
    assert found == expected


def test_frames_that_an_encoder_skips_repeat_none(tmp_path):
    """A dolly of a tenth of a pixel a frame, at a rate for which keyframes are dear; then with true repeats."""
    images = render_shot("dolly", 48, 320, 180, parallax=0.03).images

    def repeats(name, numbers, **options):
        video = write_video(tmp_path / name, [images[k] for k in numbers], options=options)
        detector = RepeatDetector()
        greys = [cv2.cvtColor(frame.image, cv2.COLOR_BGR2GRAY) for frame in read_frames(video)]
        assert len(greys) == len(numbers)
        return [detector.push(grey) for grey in greys]

    assert not any(repeats("skips.mp4", range(48), b="60000", g="12"))
    shown = [k for k in range(48) for _ in range(2 if k % 4 == 3 else 1)]
    assert cadence(repeats("repeats.mp4", shown, crf="18")) == (5, 4)


def test_images_that_all_are_the_same_repeat_none():
    detector = RepeatDetector()
    assert not any(detector.push(moving_texture(1)[0][:, :, 0]) for _ in range(20))


@pytest.mark.parametrize("shown", [0, 255])
def test_new_frames_after_a_blank_stretch_repeat_none(shown):
    """The step into the image is large, beside which its motion is small."""
    blank = np.full((240, 320), shown, np.uint8)
    detector = RepeatDetector()
    assert not any(detector.push(image) for image in [blank] * 2 + [i[:, :, 0] for i in moving_texture(10, 0.3)])


def test_a_camera_that_stops_is_no_long_row_of_repeats():
    images = moving_texture(12, 2.0)
    detector = RepeatDetector()
    found = [detector.push(image[:, :, 0]) for image in images + [images[-1]] * 20]
    assert not any(found[:12])
    assert found[12:16] == [True, True, True, False]
    assert not any(found[15:])


@pytest.mark.parametrize("light", [1.0, 0.2, 0.05])
@pytest.mark.parametrize("noise", [0.0, 1.0])
def test_the_light_of_a_shot_does_not_decide_what_repeats(light, noise):
    """A dark image of low contrast changes by little; a step of a quarter of a pixel still makes it a new one."""
    rng = np.random.default_rng(3)
    images = [i[:, :, 0] * light + rng.normal(0, noise, i.shape[:2]) for i in moving_texture(24, 0.25)]
    shown = [k for k in range(24) for _ in range(2 if k % 5 == 4 else 1)]
    detector = RepeatDetector()
    found = [detector.push(np.clip(images[k].round(), 0, 255).astype(np.uint8)) for k in shown]
    assert found == [k > 0 and shown[k] == shown[k - 1] for k in range(len(shown))]


@pytest.mark.parametrize("frames", [6, 30])
def test_a_fade_hides_no_repeat_and_makes_none(frames):
    """From full light to a twentieth and on in the dark, and the same backwards."""
    images = grainy(moving_texture(60, 0.5))
    light = np.interp(np.arange(60), [15, 15 + frames], [1.0, 0.05])
    for ramp in (light, light[::-1]):
        shown = [k for k in range(60) for _ in range(2 if k % 5 == 4 else 1)]
        detector = RepeatDetector()
        found = [detector.push(np.round(images[k] * ramp[k]).astype(np.uint8)) for k in shown]
        assert found == [k > 0 and shown[k] == shown[k - 1] for k in range(len(shown))]


@pytest.mark.parametrize(
    ("stamps", "rate"),
    [
        ([k / 60 for k in range(30)], 60.0),
        ([round(k / 23.976, 3) for k in range(30)], 23.976),
        ([None] * 9, 24.0),
        ([0.0, 0.5, 1.0, 1.5], 12.0),  # photographs one after another
        ([0.0], 24.0),
        ([k / 60 if k < 40 else 40 / 60 + (k - 40) / 24 for k in range(80)], 24.0),  # the newest frames count
    ],
)
def test_the_rate_of_a_source_is_that_of_its_timestamps(stamps, rate):
    pace = Pace()
    assert [pace.push(k, stamp) for k, stamp in enumerate(stamps)][-1] == pytest.approx(rate, rel=0.01)
    assert Pace(pace.state()).push(len(stamps), None) == 24.0
    assert pace.rate == pytest.approx(rate, rel=0.01)


def test_a_time_is_a_number_of_frames_of_at_least_one():
    assert [frames_in(0.5, rate) for rate in (12.0, 23.976, 24.0, 60.0)] == [6, 12, 12, 30]
    assert frames_in(0.01, 24.0) == 1
