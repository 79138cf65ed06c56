"""Losses that the middleware counts, without those that gaps in the numbers show too.

Fast DDS also counts losses that leave no gap: before the first message and after the last.
It counts most gaps as well, so both counts must not be added. The counter reports what no
gap explains. If a later gap explains it, that gap is not reported again.
"""

from __future__ import annotations

_LOOKS = 4
"""Looks at the graph that wait for a gap to explain a count."""


class MiddlewareLossCounter:
    """Counts the losses that the middleware of one subscription reports."""

    def __init__(self) -> None:
        self._counted = 0  # by the middleware
        self._gaps = 0
        self._before_first = 0
        self._unexplained = 0  # reported without a gap
        self._history = [0] * _LOOKS

    def add(self, count: int) -> None:
        """Add losses that the middleware reports."""
        self._counted += count

    def before_first(self, sent: int) -> int:
        """Take the first message of a publisher.

        Args:
            sent: Messages that the publisher sent before it.

        Returns:
            Number of these that were lost. The others were sent before the subscription.
        """
        found = max(0, min(sent, self._counted - self._explained()))
        self._before_first += found
        return found

    def unreported(self, missing: int) -> int:
        """Take the missing messages of a gap, and return how many were not reported yet."""
        reported = min(missing, self._unexplained)
        self._unexplained -= reported
        self._gaps += missing
        return missing - reported

    def unexplained(self, waiting: int, *, final: bool) -> int:
        """Number of losses to report without a gap; call it at each look, after all gaps.

        Args:
            waiting: Missing messages in gaps that are not reported yet.
            final: No further look follows.
        """
        # A publisher may withdraw a message, which the middleware does not count as lost.
        self._counted = max(self._counted, self._explained())
        self._history = [*self._history[1:], self._counted - self._explained() - waiting]
        found = max(0, self._history[-1] if final else min(self._history))
        self._unexplained += found
        self._history = [count - found for count in self._history]
        return found

    def _explained(self) -> int:
        return self._before_first + self._gaps + self._unexplained
