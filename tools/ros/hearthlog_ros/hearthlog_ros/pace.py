"""When messages are due that are written in blocks, so that they are published evenly."""

_MOST_LATE = 5_000_000_000  # ns; a log that is further behind is of another clock, or was read late
_STEP = 2_000_000  # ns by which a block tries whether a shorter delay will do


class PublicationDelay:
    """Delays messages by what the latest of their blocks takes, and at least by a given time.

    Parameters
    ----------
    delay : int
        Nanoseconds from the log time of a message to its publication; 0 for at once.
    """

    def __init__(self, delay: int) -> None:
        self._least = self._delay = delay

    def add_block(self, first: int, now: int) -> None:
        """Note that a block has come, after all before it were published.

        Parameters
        ----------
        first : int
            Log time of its first frame, in nanoseconds of UTC.
        """
        late = now - first - self._delay
        if self._least and 0 < late < _MOST_LATE:
            self._delay += late
        else:
            self._delay = max(self._delay - _STEP, self._least)

    def wait(self, log_time: int, now: int) -> int:
        """Return how long a message has to wait, in nanoseconds; 0 if it is due.

        Parameters
        ----------
        log_time : int
            Of the message, in nanoseconds of UTC.
        """
        wait = log_time + self._delay - now
        return wait if 0 < wait <= self._delay else 0
