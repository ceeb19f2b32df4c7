"""What a network takes for people, in a stream: its tracks are followed, but they do not vote until they agree.

The network looks at a frame now and then, beside the tracking. The tracks carry what it said from look to look, and to
the tracks that start beside them. What it marks is kept apart from the map; what agrees with the map of several
keyframes joins it, until it agrees no more. The polish judges all of it anew (`motion.suspects`).
"""

from __future__ import annotations

from collections.abc import Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from factorsfm.frames.frame import Frame
from factorsfm.mapping.landmarks import agreeing_tracks
from factorsfm.mapping.mapped_images import MappedImage
from factorsfm.mapping.mapper import Mapper
from factorsfm.mapping.young_map import YOUNG_KEYFRAMES
from factorsfm.priors.masks import MaskPrior
from factorsfm.priors.read_priors import read_mask
from factorsfm.support.context import Closing
from factorsfm.support.pace import frames_in
from factorsfm.tracks.image_tracks import ImageTracks

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]
Index = NDArray[np.int64]

_SECONDS = 0.25  # from look to look: nobody appears in that time, and a look takes the time of several frames
_SHARE = 0.25  # of the looks at a track must find it in the mask: networks miss half of a person in half of the frames
_KEYFRAMES = 8  # the newest, in which suspects are compared with the map
_LOOKS, _IN_MASK, _FIRST = range(3)  # columns of numbers by track: looks at it, those that found it in the mask, frame
_SUSPECT, _AGREES, _NEEDED, _APART = range(4)  # columns of flags by track; needed: it votes since others are too few


@dataclass(frozen=True, slots=True)
class _Look:
    """A look of the network at a frame, and the tracks (n,) that were there."""

    ids: Index
    pixels: Array
    mask: Future[Flags | None]


class Suspicion(Closing):
    """Keeps the tracks that a network suspects apart from those of the map.

    Args:
        masks: of what moves; only soft ones (see `MaskPrior`) leave anything to do.
        least: tracks of a frame that must be left; where there are fewer, the suspects vote, too.

    Attributes:
        sure: the masks, if they are not soft.
    """

    def __init__(self, masks: MaskPrior | None, least: int) -> None:
        soft = bool(getattr(masks, "soft", False))
        self.sure: MaskPrior | None = None if soft else masks
        self._network: MaskPrior | None = masks if soft else None
        self._least = least
        self._pool = ThreadPoolExecutor(1)
        self._look: _Look | None = None
        self._numbers, self._flags = np.zeros((0, 3), np.int64), np.zeros((0, 4), bool)
        self._aside: dict[int, tuple[Index, Array]] = {}  # ids and pixels of tracks, by the position of the image
        self._judged = 0  # number of keyframes of the map when suspects were compared with it

    def of_scene(self, frame: Frame, tracks: ImageTracks, mapper: Mapper) -> ImageTracks:
        """The tracks of the newest frame that vote; the others are put aside.

        Raises:
            InputError: the network failed at its last look.
        """
        if self._network is None:
            return tracks
        self._meet(tracks)
        if tracks.position % frames_in(_SECONDS, mapper.frame_rate) == 0:
            self._take_in()
            self._look = _Look(tracks.ids, tracks.pixels, self._pool.submit(read_mask, self._network, frame))
            if tracks.position == 0:  # the map may start here
                self._take_in()
        if not _at_work(mapper):  # what the graph works on stays as it is
            self._judge(mapper)
            self._settle(mapper)
        silent = self._silent[tracks.ids]
        if (~silent).sum() < self._least:
            self._flags[tracks.ids[silent], _NEEDED] = True
            return tracks
        self._aside[tracks.position] = tracks.ids[silent], tracks.pixels[silent]
        return tracks.of(~silent)

    def end(self, mapper: Mapper) -> Index:
        """Give all that is aside back to the images of the mapper; the ids (ascending) of the suspects."""
        self._take_in()
        self._settle(mapper)
        self._give_back(np.flatnonzero(self._flags[:, _APART]), mapper)
        return np.flatnonzero(self._flags[:, _SUSPECT] & ~self._flags[:, _NEEDED])

    def close(self) -> None:
        """Let the thread go."""
        self._pool.shutdown()

    def state(self) -> dict[str, Any]:
        """Everything that `restore` needs; waits for the network."""
        look = self._look
        return {
            "look": (look.ids, look.pixels, look.mask.result()) if look is not None else None,
            "numbers": self._numbers,
            "flags": self._flags,
            "aside": self._aside,
            "judged": self._judged,
        }

    def restore(self, state: Mapping[str, Any]) -> None:
        """Go on where `state` was taken."""
        if state["look"] is not None:
            ids, pixels, mask = state["look"]
            self._look = _Look(ids, pixels, Future())
            self._look.mask.set_result(mask)
        self._numbers, self._flags = state["numbers"], state["flags"]
        self._aside, self._judged = dict(state["aside"]), state["judged"]

    @property
    def _silent(self) -> Flags:
        """By track, whether it does not vote."""
        return np.asarray(self._flags[:, _SUSPECT] & ~self._flags[:, _AGREES])

    def _meet(self, tracks: ImageTracks) -> None:
        """A new track is what its nearest neighbour is, as if it had been looked at once."""
        new = tracks.ids >= len(self._numbers)
        if not new.any():
            return
        grown = int(tracks.ids[-1]) + 1 - len(self._numbers)
        self._numbers = np.concatenate([self._numbers, np.tile([0, 0, tracks.position], (grown, 1))])
        self._flags = np.pad(self._flags, ((0, grown), (0, 0)))
        if new.all():
            return
        known, born = tracks.of(~new), tracks.ids[new]
        distance = np.linalg.norm(tracks.pixels[new][:, None] - known.pixels, axis=2)
        self._flags[born, : _AGREES + 1] = self._flags[known.ids[np.argmin(distance, axis=1)], : _AGREES + 1]
        self._flags[born, _APART] = self._silent[born]
        self._numbers[born, _LOOKS], self._numbers[born, _IN_MASK] = 1, self._flags[born, _SUSPECT]

    def _take_in(self) -> None:
        """Wait for the network, and let what it says of its tracks count."""
        if self._look is None:
            return
        look, self._look = self._look, None
        mask = look.mask.result()
        if mask is None:
            return
        x, y = np.clip(np.rint(look.pixels).astype(int), 0, np.array(mask.shape[::-1]) - 1).T
        self._numbers[look.ids, _LOOKS] += 1
        self._numbers[look.ids, _IN_MASK] += mask[y, x]
        looks, in_mask, _ = self._numbers[look.ids].T
        self._flags[look.ids, _SUSPECT] = in_mask >= np.maximum(_SHARE * looks, 1)

    def _judge(self, mapper: Mapper) -> None:
        """After a keyframe, compare the suspects with the map."""
        if len(mapper.keyframes) == self._judged:
            return
        self._judged = len(mapper.keyframes)
        if self._judged <= YOUNG_KEYFRAMES:  # the poses of a young map are not exact enough
            return
        images = [replace(mapper.images[k]) for k in mapper.keyframes[-_KEYFRAMES:]]
        for image in images:
            if image.tracks.position in self._aside:
                image.take_up_tracks(*self._aside[image.tracks.position])
        suspects = np.flatnonzero(self._flags[:, _SUSPECT])
        ids, agree = agreeing_tracks(images, mapper.points, suspects, mapper.focal, mapper.options)
        self._flags[ids, _AGREES] = agree

    def _settle(self, mapper: Mapper) -> None:
        """Let the images of the mapper see those tracks that vote, and no others."""
        silent, apart = self._silent, self._flags[:, _APART].copy()
        self._put_aside(np.flatnonzero(silent & ~apart), mapper)
        self._give_back(np.flatnonzero(~silent & apart), mapper)
        self._flags[:, _APART] = silent

    def _put_aside(self, ids: Index, mapper: Mapper) -> None:
        for image in self._that_see(ids, mapper):
            mine = np.isin(image.tracks.ids, ids)
            known, pixels = self._aside.get(image.tracks.position, (ids[:0], np.zeros((0, 2))))
            together = np.r_[known, image.tracks.ids[mine]], np.r_[pixels, image.tracks.pixels[mine]]
            self._aside[image.tracks.position] = together
            image.forget_tracks(ids)

    def _give_back(self, ids: Index, mapper: Mapper) -> None:
        for image in self._that_see(ids, mapper):
            known, pixels = self._aside.get(image.tracks.position, (ids[:0], np.zeros((0, 2))))
            mine = np.isin(known, ids)
            self._aside[image.tracks.position] = known[~mine], pixels[~mine]
            image.take_up_tracks(known[mine], pixels[mine])

    def _that_see(self, ids: Index, mapper: Mapper) -> list[MappedImage]:
        """The images from the first on that may see one of some tracks."""
        return mapper.images[int(self._numbers[ids, _FIRST].min()) :] if len(ids) else []


def _at_work(mapper: Mapper) -> bool:
    """Whether the graph works on a keyframe, which the map has not taken over yet."""
    return any(image.keyframe for image in mapper.images[max(mapper.keyframes, default=-1) + 1 :])
