"""Frames in which hardly anything can be followed, taken up by the tracks of the user."""

from __future__ import annotations

from dataclasses import replace
from itertools import chain

import numpy as np

from factorsfm.mapping.incremental import IncrementalMapper
from factorsfm.mapping.landmarks import map_tracks
from factorsfm.mapping.map_registration import NotOnMap, register_on_map
from factorsfm.mapping.mapped_images import MappedImage, nearest_registered
from factorsfm.mapping.starter import Starter
from factorsfm.mapping.starts import NoStart
from factorsfm.polish.measured import MeasuredShot
from factorsfm.tracks.supervised import LEAST_SUPERVISED

_LEAST_AT_START = 8  # supervised tracks that two frames share, where there is no map: what an essential matrix needs


def taken_up(measured: MeasuredShot) -> MeasuredShot:
    """The shot with further frames registered, which supervised tracks join to the others; a note tells them.

    The map goes on from the frames that have a pose; where it has none, it starts with supervised tracks alone.
    """
    if all(image.registered for image in measured.images):
        return measured
    supervised = _SupervisedMap(measured)
    supervised.grow()
    found = replace(measured, images=supervised.images, map_points=supervised.points.all())
    if (new := supervised.registered - sum(image.registered for image in measured.images)) <= 0:
        return found
    note = f"Supervised tracks have joined {new} frame{'s' * (new != 1)} that could not be registered without them."
    return replace(found, supervised=replace(measured.supervised, join=True), notes=(*measured.notes, note))


class _SupervisedMap(IncrementalMapper):
    """The map of a shot that goes on with its supervised tracks."""

    def __init__(self, measured: MeasuredShot) -> None:
        images = [replace(image) for image in measured.images]
        super().__init__(images, measured.camera.mean_focal_length(), measured.options)
        self._supervised = measured.supervised.ids
        self._sigma = float(np.median(measured.supervised.sigma))
        if self.registered >= 2:
            self.points.set(*measured.map_points)
        else:
            for image in self.images:
                image.forget(image.status, image.message)

    def grow(self) -> None:
        """Register images from the ends and gaps of the map on: backwards, then forwards. Say why not the rest."""
        if not self.registered:
            self._start()
        least, grows = LEAST_SUPERVISED if self.registered else _LEAST_AT_START, self.registered > 0
        while grows:
            before = self.registered
            for image in chain(reversed(self.images), self.images):
                if not image.registered:
                    self._take_up(image)
            grows = self.registered > before
        for image in self.images:
            if not image.registered and (count := len(self._supervised_alone(image).tracks.ids)) < least:
                image.message += f"; {count} of {least} needed supervised tracks"

    def _start(self) -> None:
        options = replace(self.options, min_tracks=_LEAST_AT_START, pixel_sigma=self._sigma)
        starter = Starter(options, has_prior=False)
        own = [self._supervised_alone(image) for image in self.images]
        start = starter.last_resort([image for image in own if len(image.tracks.ids) >= _LEAST_AT_START], self.focal)
        if not isinstance(start, NoStart):
            self._accept_start(start)

    def _take_up(self, image: MappedImage) -> None:
        """Register an image by its supervised tracks, else by all: what else is followed may not be the scene."""
        near = nearest_registered(self.images, image.tracks.position)
        map_tracks(image, self.images, self.points, self.options, self.focal)
        few = replace(self.options, min_inliers=LEAST_SUPERVISED)
        for seen, options in ((self._supervised_alone(image), few), (image, self.options)):
            found = register_on_map(seen, self.points, near, self.focal, options, in_order=False)
            if not isinstance(found, NotOnMap):
                self._accept(image, found)
                return

    def _supervised_alone(self, image: MappedImage) -> MappedImage:
        tracks = image.tracks
        return replace(image, tracks=tracks.of(np.isin(tracks.ids, self._supervised)))
