"""Updates of the map in the graph's process, beside the registration of the frames that follow."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from concurrent.futures import Future
from typing import Any

from factorsfm.graph.contents import LiveGraph, graph_contents
from factorsfm.graph.keyframe_graph import KeyframeGraph
from factorsfm.graph.process import GraphProcess, GraphProcessKilledError
from factorsfm.mapping.map_copy import MapCopy, MapUpdate
from factorsfm.mapping.map_update import update_map
from factorsfm.priors.image_depth import ImageDepth

logger = logging.getLogger(__name__)

UPDATES = update_map.__module__  # for `GraphProcess`


class GraphUpdates:
    """The updates of a map by its keyframes, of which one at most is pending.

    The map takes an update over a fixed number of images after it began, however long it took: so what the map gives
    does not depend on the speed of the machine.

    Args:
        graph: that of the keyframes.
    """

    def __init__(self, graph: GraphProcess) -> None:
        self._graph = graph
        self._pending: Future[MapUpdate] | None = None
        self._due = 0  # number of images with which the map takes it over

    def state(self) -> dict[str, Any]:
        """Everything that `restore` needs; waits for the pending update."""
        return {"update": self._pending.result() if self._pending is not None else None, "_due": self._due}

    def restore(self, state: Mapping[str, Any]) -> None:
        """Go on where `state` was taken."""
        self._due = state["_due"]
        if state["update"] is not None:
            self._pending = Future()
            self._pending.set_result(state["update"])

    @property
    def pending(self) -> bool:
        """Whether an update has begun that the map has not taken over yet."""
        return self._pending is not None

    def is_due(self, images: int) -> bool:
        """Whether the map takes the pending update over with so many images."""
        return self._pending is not None and images >= self._due

    def begin(self, copy: MapCopy, read_depth: Callable[[], ImageDepth | None] | None, due: int) -> None:
        """Begin an update, see `submit_update`; `due`: number of images with which the map takes it over."""
        self._pending, self._due = submit_update(self._graph, copy, read_depth), due

    def taken(self) -> MapUpdate | None:
        """The pending update, which is waited for, and pending no more; None if there is none."""
        pending, self._pending = self._pending, None
        return pending.result() if pending is not None else None

    def start_anew(self) -> None:
        """The next update begins another map."""
        self._graph.start_anew()

    def contents(self) -> LiveGraph:
        """A copy of the graph as the last update left it, empty before the first one."""
        return graph_contents(self._graph)

    def close(self) -> None:
        """Let the graph go; what it is working on is lost."""
        self._graph.close()


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
