"""Time of the stages of a reconstruction."""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Iterator
from contextlib import contextmanager


class StageSeconds(defaultdict[str, float]):
    """Seconds by stage.

    Example:
        >>> seconds = StageSeconds()
        >>> with seconds.of("tracking"):
        ...     pass
        >>> list(seconds)
        ['tracking']
    """

    def __init__(self) -> None:
        super().__init__(float)

    @contextmanager
    def of(self, stage: str) -> Iterator[None]:
        """Add the time inside the ``with`` statement to a stage."""
        start = time.perf_counter()
        try:
            yield
        finally:
            self[stage] += time.perf_counter() - start
