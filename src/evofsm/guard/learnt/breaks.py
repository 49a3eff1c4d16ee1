"""Whether disturbances get worse: certificates break in more episodes than they used to.

A certificate says that all that is remembered is survived. It breaks where something begins that is
worse than all of that. That happens now and then; where it suddenly happens in every second
episode, what is remembered is no measure any more of what may begin. A cumulative sum tells (Page,
"Continuous inspection schemes", Biometrika 1954).
"""

from __future__ import annotations

import math
from typing import NamedTuple

# Of the share of episodes with a broken certificate: what it is at first, how much more it may be
# than of late, what would be worse, and from where on nothing is told apart from that.
_FIRST, _MORE, _WORSE, _USUAL = 0.5, 0.05, 0.5, 0.2
# Weight of an episode in that share; log likelihood ratio from which on it is believed.
_WEIGHT, _DOUBT = 0.05, 6.0


class Breaks(NamedTuple):
    """In how many episodes certificates broke, and the doubt that it is still so.

    Examples
    --------
    >>> breaks = Breaks()
    >>> for episode in range(60):
    ...     breaks = breaks.after(episode, broke=episode < 10)
    >>> for episode in range(60, 64):
    ...     breaks = breaks.after(episode, broke=True)
    >>> breaks.worse
    60
    """

    share: float = _FIRST  #: of episodes, those of late count most
    doubt: float = 0.0  #: that it is still so: a log likelihood ratio
    since: int = 0  #: the episode that brought it up, from 0
    worse: int = -1  #: since which episode disturbances are worse, from 0; -1: since none

    def after(self, episode: int, *, broke: bool, failed: bool = False) -> Breaks:
        """What it is after an episode, whose number is from 0.

        One in which a certificate broke and which ``failed`` says twice as much.
        """
        share = self.share + _MORE
        likelier = _WORSE / share if broke else (1.0 - _WORSE) / (1.0 - share)
        times = 2.0 if failed else 1.0
        doubt = max(0.0, self.doubt + times * math.log(likelier)) if share < _USUAL else 0.0
        since = self.since if self.doubt > 0.0 else episode
        if doubt > _DOUBT:
            return Breaks(worse=since)
        if doubt > 0.0:  # before a doubt it was as ever
            return Breaks(self.share, doubt, since, self.worse)
        return Breaks(self.share + _WEIGHT * (broke - self.share), 0.0, since, self.worse)
