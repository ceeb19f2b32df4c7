"""Outputs at the place of footage: refused, and everything else is written."""

from pathlib import Path

import pytest

from factorsfm.frames.targets import spare_footage
from factorsfm.support.errors import InputError


@pytest.fixture
def footage(tmp_path: Path) -> Path:
    """A movie, a folder of plates, another one of links to them, and a link to the movie."""
    (tmp_path / "shot.mp4").write_text("movie")
    (tmp_path / "link.mp4").symlink_to("shot.mp4")
    (tmp_path / "plates").mkdir()
    (tmp_path / "links").mkdir()
    (tmp_path / "links" / "loop.png").symlink_to("loop.png")
    for number in (1001, 1002):
        (tmp_path / "plates" / f"plate.{number}.png").write_text("plate")
        (tmp_path / "links" / f"plate.{number}.png").symlink_to(tmp_path / "plates" / f"plate.{number}.png")
    return tmp_path


@pytest.mark.parametrize(
    ("target", "source"),
    [
        ("shot.mp4", "shot.mp4"),
        ("plates/../shot.mp4", "shot.mp4"),
        ("link.mp4", "shot.mp4"),
        ("shot.mp4", "link.mp4"),
        ("plates", "plates"),
        ("plates", "links"),
        ("plates/plate.1001.png", "plates"),
        ("plates/plate.1001.png", "links"),
        ("plates/plate.1003.png", "plates"),
        (".", "shot.mp4"),
    ],
)
def test_what_would_change_footage_is_refused(footage: Path, target: str, source: str) -> None:
    with pytest.raises(InputError, match=f"the output .*{target} would overwrite the footage .*{source}; choose"):
        spare_footage([footage / "new", footage / target], None, footage / source)


@pytest.mark.parametrize(
    ("target", "source"),
    [
        ("plates/overlay.mp4", "plates"),
        ("plates/result", "plates"),
        ("plates2", "plates"),
        ("shot.mov", "shot.mp4"),
        ("plate.1001.png", "plates"),
        ("shot.mp4", "camera:0"),
        ("shot.mp4", "gone.mp4"),
        ("shot.mp4", "rtsp://camera/" + 300 * "x"),
    ],
)
def test_what_lies_beside_footage_is_written(footage: Path, target: str, source: str) -> None:
    spare_footage([footage / target], source if ":" in source else str(footage / source), "frames", 7)
