"""Whether the keyframes of a map rely on the depth prior."""

from __future__ import annotations

from dataclasses import dataclass

from factorsfm.mapping.map_copy import MapUpdate

_MOST_MIRRORED = 3  # updates in a row; then the prior is wrong, not the geometry
_MOST_MISSING = 3  # keyframes in a row without a depth map; the next one does without


@dataclass(slots=True)
class PriorTrust:
    """Goes on with the prior until it contradicts itself, or again and again the geometry.

    Attributes:
        wanted: whether there is a prior that the options use.
        lost: why it takes no part any more, empty while it does.
        mirrored, missing: updates in a row that were rolled back as mirrored, and that had no depth map.
    """

    wanted: bool
    lost: str = ""
    mirrored: int = 0
    missing: int = 0

    @property
    def active(self) -> bool:
        """Whether the prior takes part in the updates of the map."""
        return self.wanted and not self.lost

    def lose(self, update: MapUpdate) -> bool:
        """Judge the prior by an update; whether it takes no part from now on."""
        self.mirrored = self.mirrored + 1 if update.mirrored else 0
        reason = update.reason if update.no_prior else ""
        if self.mirrored >= _MOST_MIRRORED:
            reason = f"the geometry is its mirror image in {self.mirrored} updates in a row"
        if not reason or not self.active:
            return False
        self.lost = reason
        return True

    def waits(self, update: MapUpdate) -> bool:
        """Whether a keyframe without a depth map is passed over, since another image may have one."""
        if self.active and update.depth is None and self.missing < _MOST_MISSING:
            self.missing += 1
            return True
        return False
