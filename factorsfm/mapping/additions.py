"""Factors that the caller adds to the graph of a map: from when they are offered until the last frame."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from typing import Any

from factorsfm.graph.added_factors import NOTHING_ADDED, AddedFactors
from factorsfm.graph.factor_checks import checked_factors
from factorsfm.mapping.map_contents import MapContents
from factorsfm.mapping.map_copy import MapUpdate

logger = logging.getLogger(__name__)


class Additions:
    """What the caller has added to the graph of one map.

    Attributes:
        taken: the factors that the graph has taken, as they were given; offered: those that wait for an update.
        active: what an update needs of them: those on its window, and what the others have become.
    """

    def __init__(self) -> None:
        self.taken: list[AddedFactors] = []
        self.offered: list[AddedFactors] = []
        self.active = NOTHING_ADDED
        self._following = 0  # number of the next factor
        self._names: set[int] = set()  # all variables of the caller's own

    def state(self) -> dict[str, Any]:
        """Everything that `restore` needs."""
        return {
            "taken": self.taken, "offered": self.offered, "active": self.active, "following": self._following,
            "names": sorted(self._names),
        }  # fmt: skip

    def restore(self, state: Mapping[str, Any]) -> None:
        """Go on where `state` was taken."""
        self.taken, self.offered = list(state["taken"]), list(state["offered"])
        self.active, self._following, self._names = state["active"], state["following"], set(state["names"])

    def offer(self, graph: object, values: object, contents: MapContents) -> None:
        """Check factors, and let the next update take them; errors as in `checked_factors`."""
        earlier = [self.active, *self.offered]
        added = checked_factors(graph, values, contents, earlier, self._names, self._following)
        self._names |= added.own_names
        self._following += len(added.numbers)
        self.offered.append(added)

    def present(self) -> AddedFactors:
        """What is active, and what waits."""
        return AddedFactors.joined([self.active, *self.offered])

    def everything(self) -> AddedFactors:
        """All factors, as they were given, those included that wait."""
        return AddedFactors.joined([*self.taken, *self.offered])

    def follow(self, update: MapUpdate) -> str:
        """Take over what an update made of the factors; a sentence where that is out of the ordinary."""
        if not update.committed or update.added is None:
            return ""
        offered, self.offered = self.offered[: update.offered], self.offered[update.offered :]
        self.active = update.added
        self._following = max([self._following, *(number + 1 for number in update.added.numbers)])
        if update.refused:
            self._names -= {name for added in offered for name in added.own_names}
            logger.warning(update.refused)
            return update.refused
        self.taken += offered
        said = []
        if update.unit != 1.0:
            said.append(f"the factors added set the unit of length: lengths are now {update.unit:.4g} times as long")
        if offered and update.misfit:
            where = "factors are in the world of the first keyframe"
            said.append(f"of the factors added, {update.misfit} after the update; {where}")
            logger.warning(said[-1])
        return "; ".join(said)
