"""What is said of frames that have no pose."""

import numpy as np
import pycolmap
import pytest

import factorsfm
from factorsfm.mapping.mapped_images import MappedImage
from factorsfm.result.lost_frames import lost_frames
from factorsfm.result.reconstruction import FrameResult
from factorsfm.support.errors import ReconstructionError
from factorsfm.support.status import FrameStatus
from factorsfm.tracks.image_tracks import ImageTracks
from tests.frames.test_cuts import HEIGHT, WIDTH, shot

LOST, BLANK, POSED = FrameStatus.LOST, FrameStatus.BLANK, FrameStatus.REGISTERED
CAMERA = pycolmap.Camera.create_from_model_name(1, "SIMPLE_PINHOLE", 100.0, 200, 100)


def said(statuses: list[FrameStatus], kept: int) -> str:
    """Of frames with 100 tracks of which so many go on in the next one."""
    frames, images = [], []
    for k, status in enumerate(statuses):
        pose = pycolmap.Rigid3d() if status is POSED else None
        frames.append(FrameResult(10 + k, str(k), None, status, "", pose))
        ids = np.arange(100) + k * (100 - kept)
        images.append(MappedImage(ImageTracks(k, ids, np.zeros((100, 2)), CAMERA), status, ""))
    return lost_frames(frames, images)


def test_frames_without_a_pose_are_named():
    assert said([POSED] * 4, 0) == ""
    assert said([LOST, LOST, POSED, POSED, LOST], 80) == "Without a pose: frames 10 to 11, 14 (3 of 5)."
    assert said([POSED, LOST] * 5, 80).endswith("frames 11, 13, 15 and 2 more stretches (5 of 10).")


def test_steps_are_too_large_where_tracks_end():
    steps = "only 5 % of the points of a frame can be followed into the next one"
    assert steps in said([POSED, POSED, LOST, LOST], 5)
    assert "steps" not in said([POSED, POSED, LOST, LOST], 20)
    assert "steps" not in said([POSED, BLANK, POSED, POSED], 5)  # what is blank has no tracks to follow


def test_a_frame_a_second_ends_with_a_word_on_its_steps():
    pictures = shot(0, 1) + shot(1, 1) + shot(2, 1) + shot(3, 1)
    with pytest.raises(ReconstructionError, match=r"The steps between frames are too large: only [0-9] %"):
        factorsfm.reconstruct(pictures, depth=None, unordered=False)


def test_a_flash_before_the_map_starts_loses_no_other_frame_and_says_nothing_of_steps():
    pictures = [*shot(0, 8), *shot(1, 1), *shot(0)[8:]]
    camera = pycolmap.Camera.create_from_model_name(1, "SIMPLE_PINHOLE", 480.0, WIDTH, HEIGHT)
    result = factorsfm.reconstruct(pictures, camera=camera, depth=None, unordered=False)
    assert [k for k, frame in enumerate(result.frames) if not frame.registered] == [8]
    assert [note for note in result.notes if "Without a pose" in note] == ["Without a pose: frame 8 (1 of 17)."]
