"""What is found beside a shot, and footage that holds several."""

from pathlib import Path

import cv2
import numpy as np
import pytest

import factorsfm
from factorsfm.frames.edits import AnotherView, find_shots, read_edit, until_another_view
from factorsfm.frames.frame import Frame
from factorsfm.frames.reading import read_frames
from factorsfm.support.errors import ReconstructionError
from factorsfm.support.status import FrameStatus
from tests.frames.test_cuts import HEIGHT, WIDTH, scenery, shot
from tests.rendered import rendered
from tests.video_files import interlaced

BLACK = np.full((HEIGHT, WIDTH, 3), 16, np.uint8)


def bars(width: int = WIDTH, height: int = HEIGHT) -> np.ndarray:
    colors = np.array(
        [[192, 192, 192], [0, 192, 192], [192, 192, 0], [0, 192, 0], [192, 0, 192], [0, 0, 192]], np.uint8
    )
    image = np.repeat(colors, -(-width // 6), axis=0)[None, :width].repeat(height, axis=0)
    image[3 * height // 4 :] = np.linspace(0, 255, width)[None, :, None]
    return image


def slate(clock: int = 0) -> np.ndarray:
    image = np.full((HEIGHT, WIDTH, 3), 40, np.uint8)
    for k, text in enumerate(["XY_010_0040", "take 3  24 fps", "35 mm", f"{clock:06d}"]):
        cv2.putText(image, text, (30, 60 + 55 * k), cv2.FONT_HERSHEY_SIMPLEX, 0.6 if k == 3 else 1.4, (230,) * 3, 2)
    return image


def write(folder: Path, images: list[np.ndarray], first: int = 1001) -> Path:
    folder.mkdir()
    for number, image in enumerate(images, first):
        cv2.imwrite(str(folder / f"plate.{number:04d}.png"), image)
    return folder


def found(folder: Path, images: list[np.ndarray]) -> tuple[tuple[int, ...], list[tuple[int, int]]]:
    edit = read_edit(read_frames(write(folder, images)))
    return edit.starts, [(part.first, part.last) for part in edit.left_out]


def test_slates_and_bars_are_beside_the_shot(tmp_path):
    grain = np.random.default_rng(0)
    still = [np.clip(bars() + grain.normal(0, 2, (HEIGHT, WIDTH, 3)), 0, 255).astype(np.uint8) for _ in range(20)]
    cards = [slate(clock) for clock in range(12)]
    starts, left_out = found(tmp_path / "a", [*still, *cards, *[BLACK] * 6, *shot(1, 24), *[BLACK] * 6])
    assert (starts, left_out) == ((1039,), [(1001, 1020), (1021, 1032)])
    assert found(tmp_path / "b", [slate(), *shot(1, 24)]) == ((1002,), [(1001, 1001)])


def test_a_piece_of_another_shot_is_left_out_and_a_shot_is_not(tmp_path):
    assert found(tmp_path / "a", shot(0, 40) + shot(1, 5)) == ((1001,), [(1041, 1045)])
    assert found(tmp_path / "b", shot(0, 40) + shot(1, 8)) == ((1001, 1041), [])
    assert found(tmp_path / "c", shot(0, 12) + shot(1, 5)) == ((1001, 1013), [])  # more than a quarter
    assert found(tmp_path / "d", shot(0, 5) + shot(1, 5)) == ((1001,), [])  # single images, or too large steps


@pytest.mark.parametrize(("zoom", "shots"), [(1.15, 1), (1.4, 2)])
def test_dropped_frames_are_no_cut_while_the_view_is_nearly_the_same(tmp_path, zoom, shots):
    """A camera has turned by 6 degrees and come nearer by 15 %; 40 % are another set-up."""
    picture = scenery(3)
    noise = np.random.default_rng(4).integers(0, 256, (picture.shape[0] // 4, picture.shape[1] // 4, 3), np.uint8)
    detailed = cv2.addWeighted(picture, 0.6, cv2.resize(noise, picture.shape[1::-1]), 0.4, 0)

    def view(x: int, zoom: float, degrees: float) -> np.ndarray:
        warp = cv2.getRotationMatrix2D((x + WIDTH / 2, 100 + HEIGHT / 2), degrees, zoom)
        warp[:, 2] -= x, 100
        return cv2.warpAffine(detailed, warp, (WIDTH, HEIGHT))

    images = [view(2 * k, *((1.0, 0.0) if k < 12 else (zoom, 6.0))) for k in range(24)]
    with pytest.raises(AnotherView):  # the detector alone sees a cut
        list(until_another_view(Frame(k, image, str(k)) for k, image in enumerate(images)))
    assert len(found(tmp_path / "a", images)[0]) == shots


def test_a_whip_pan_beside_a_shot_is_left_out(tmp_path):
    """Six frames, each of which averages a pan over 200 pixels; as many sharp ones are a shot of their own."""
    fine = np.random.default_rng(0).integers(0, 80, (HEIGHT, 2 * WIDTH, 3), np.uint8)
    other, own = (scenery(seed)[100 : 100 + HEIGHT] // 2 + fine for seed in (1, 0))
    whip = [
        np.mean([other[:, x : x + WIDTH] for x in range(40 * k, 40 * k + 200, 2)], axis=0).astype(np.uint8)
        for k in range(6)
    ]
    sharp = [other[:, 6 * k : 6 * k + WIDTH] for k in range(6)]
    rest = [own[:, 6 * k : 6 * k + WIDTH] for k in range(19)]
    assert found(tmp_path / "a", whip + rest) == ((1007,), [(1001, 1006)])
    assert found(tmp_path / "b", sharp + rest) == ((1001, 1007), [])


def test_a_step_over_dropped_frames_is_no_further_shot(shared_data):
    """Of a wide arc 3 to 5 frames are missing four times."""
    images = [frame.image for frame in read_frames(shared_data / "studiosim" / "d09_livingroom_wide" / "shot.mp4")]
    dropped = {*range(10, 13), *range(25, 29), *range(40, 45), *range(60, 64)}
    kept = [image for k, image in enumerate(images) if k not in dropped]
    assert find_shots(kept) == [range(len(kept))]


def test_frames_of_one_view_all_come():
    frames = [Frame(k, image, str(k)) for k, image in enumerate(shot(0))]
    assert list(until_another_view(frames)) == frames


def test_several_shots_are_refused_with_what_to_do(tmp_path):
    folder = write(tmp_path / "film", shot(0, 12) + shot(1, 12) + shot(2, 12) + shot(3, 12))
    reason = (
        "3 cuts, before frames 1013, 1025, 1037: these are 4 shots; use batch, which solves each of them, or --frames "
        "for one, such as --frames 1001:1013"
    )
    with pytest.raises(ReconstructionError) as refused:
        factorsfm.reconstruct(folder, depth=None)
    assert str(refused.value) == reason


@pytest.mark.parametrize(("fields", "second"), [("auto", 24), ("blend", 12)])
def test_cuts_of_interlaced_video_count_as_its_frames_are_read(tmp_path, fields, second):
    moments = [image[:268] for image in shot(0, 24) + shot(1, 24)]  # fields of an even number of lines
    film = interlaced(tmp_path / "film.mp4", moments)
    with pytest.raises(ReconstructionError, match=f"1 cut, before frame {second}: .* --frames 0:{second}$"):
        factorsfm.reconstruct(film, depth=None, fields=fields)


def test_a_shot_is_solved_between_its_handles(tmp_path):
    truth = rendered("truck")
    height, width = truth.images[0].shape[:2]
    black = np.full((height, width, 3), 16, np.uint8)
    images = [*[bars(width, height)] * 10, *[black] * 3, *truth.images, *[black] * 3]
    whole = factorsfm.reconstruct(write(tmp_path / "handles", images), camera=truth.camera, depth=None)
    alone = factorsfm.reconstruct(write(tmp_path / "shot", truth.images, 1014), camera=truth.camera, depth=None)
    assert [frame.index for frame in whole.frames] == list(range(1001, 1025))
    statuses = [frame.status for frame in whole.frames]
    assert statuses[:10] == [FrameStatus.LEFT_OUT] * 10
    assert statuses[10:13] == statuses[21:] == [FrameStatus.BLANK] * 3
    assert [frame.index for frame in whole.registered] == [frame.index for frame in alone.registered]
    assert "Frames 1001 to 1010 are a picture that stands still (a slate, a card, bars): left out." in whole.notes
    path = np.ptp(alone.camera_centers(), axis=0).max()
    np.testing.assert_allclose(whole.camera_centers(), alone.camera_centers(), atol=0.01 * path)
    seen = {whole.frames[position].index for position in whole.observation_frame}
    assert seen == {alone.frames[position].index for position in alone.observation_frame}
