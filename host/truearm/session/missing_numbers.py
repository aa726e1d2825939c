"""What a numbered stream lacks, where numbers that were missed may still come late."""

from __future__ import annotations

from collections import deque

REMEMBERED = 256  # holes, and late numbers that fill none; a number that comes later than that is not looked for


class MissingNumbers:
    """Counts numbers that were skipped and did not come late. A number that was never missed, or comes late twice, fills nothing."""

    def __init__(self) -> None:
        self.lost = 0
        self._open: deque[tuple[int, int]] = deque(maxlen=REMEMBERED)  # the numbers around each hole
        self._spare: deque[int] = deque(maxlen=REMEMBERED)  # late numbers whose hole may still show

    def skip(self, before: int, after: int) -> None:
        """``after`` came next after ``before``."""
        if after - before > 1:
            self.lost += after - before - 1
            self._open.append((before, after))
            for number in [n for n in self._spare if before < n < after]:
                self._spare.remove(number)
                self.fill(number)

    def fill(self, number: int) -> None:
        """A number came late, or out of time before the next one showed that it was skipped."""
        for k, (before, after) in enumerate(self._open):
            if before < number < after:
                del self._open[k]
                self._open.extend((a, b) for a, b in ((before, number), (number, after)) if b - a > 1)
                self.lost -= 1
                return
        self._spare.append(number)

    def forget(self) -> None:
        """Numbers begin anew; what was lost stays so."""
        self._open.clear()
        self._spare.clear()
