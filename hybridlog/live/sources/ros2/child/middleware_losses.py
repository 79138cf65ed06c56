"""What the middleware says it has lost, beside the gaps in the numbers.

Fast DDS knows of losses that leave no gap: before the first message that came, and after
the last. It counts most of the gaps too, so its count and theirs must not be added. What
it says and no gap explains is told of; a gap that shows later, and was told of so, is not
told of again.

Runs under Python 3.10 as well, with nothing but the standard library.
"""

from __future__ import annotations

_LOOKS = 4
"""Looks at the graph during which no gap has explained what the middleware says."""


class MiddlewareLossCounter:
    """The count of one subscription."""

    def __init__(self) -> None:
        self._said = 0
        self._gaps = 0
        self._heads = 0
        self._open = 0
        self._left = [0] * _LOOKS

    def add(self, count: int) -> None:
        """The middleware says that it has lost some more."""
        self._said += count

    def before_first(self, before: int) -> int:
        """The first message of all has come.

        Args:
            before: Messages that its publisher sent before it.

        Returns:
            How many of them were lost; the others were sent before we listened.
        """
        found = max(0, min(before, self._said - self._explained()))
        self._heads += found
        return found

    def unreported(self, missing: int) -> int:
        """A gap is told of; how many of it have not been told of before."""
        again = min(missing, self._open)
        self._open -= again
        self._gaps += missing
        return missing - again

    def unexplained(self, waiting: int, *, final: bool) -> int:
        """What is to be told of now; to be called at each look, after all gaps.

        Args:
            waiting: Messages in gaps that have not been told of.
            final: There will be no other look.
        """
        # A publisher may take a message back without the middleware calling it lost.
        self._said = max(self._said, self._explained())
        self._left = [*self._left[1:], self._said - self._explained() - waiting]
        found = max(0, self._left[-1] if final else min(self._left))
        self._open += found
        self._left = [left - found for left in self._left]
        return found

    def _explained(self) -> int:
        return self._heads + self._gaps + self._open
