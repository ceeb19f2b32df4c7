"""Updates of the map in the graph's process, beside the registration of the frames that follow."""

from __future__ import annotations

import logging
from collections.abc import Callable
from concurrent.futures import Future

from factorsfm.graph.keyframe_graph import KeyframeGraph
from factorsfm.graph.process import GraphProcess, GraphProcessKilledError
from factorsfm.mapping.map_copy import MapCopy, MapUpdate
from factorsfm.mapping.map_update import update_map
from factorsfm.priors.image_depth import ImageDepth

logger = logging.getLogger(__name__)

UPDATES = update_map.__module__  # for `GraphProcess`


def submit_update(
    graph: GraphProcess, copy: MapCopy, read_depth: Callable[[], ImageDepth | None] | None
) -> Future[MapUpdate]:
    """Begin an update (see `update_map`), which raises what it raises there.

    The map outlives the graph's process: where that is killed the update is rolled back, and another process builds the
    graph from the map with the next one.

    Args:
        copy: of the map; read_depth: gives the prior of the new keyframe, called from another thread.
    """

    def work() -> MapUpdate:
        if read_depth is not None:
            copy.read_depth(read_depth)
        if len(copy.keyframes) == 1:  # is the world, and no matter of the graph: no need to wait for a process
            return update_map(copy, KeyframeGraph())
        try:
            return graph.ask(update_map, copy.needed())
        except GraphProcessKilledError as error:
            tracks = copy.newest.tracks
            logger.warning("update at frame %d rolled back: %s", tracks.position, error)
            return MapUpdate(tracks.position, tracks.depth, False, str(error))

    return graph.submit(work)
