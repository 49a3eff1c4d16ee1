"""Questions to a finite Markov chain, answered by linear algebra on its transition matrix.

P is the (n, n) matrix of probabilities from state (row) to state (column).

References
----------
W. Grassmann, M. Taksar, D. Heyman, "Regenerative analysis and steady state distributions for
Markov chains", Operations Research 33 (1985).
P. Metzner, C. Schuette, E. Vanden-Eijnden, "Transition path theory for Markov jump processes",
Multiscale Model. Simul. 7 (2009).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def leads_to(P: NDArray[np.float64]) -> NDArray[np.bool_]:
    """(n, n) whether a state (row) ever leads to a state (column); each does to itself."""
    ways = np.asarray((P > 0.0) | np.eye(len(P), dtype=np.bool_), np.float32)
    for _ in range(max(len(P) - 1, 1).bit_length()):
        ways = np.minimum(ways @ ways, np.float32(1.0))  # as numbers it is many times quicker
    return np.asarray(ways > 0.0)


def stationary(P: NDArray[np.float64]) -> NDArray[np.float64]:
    """(n,) distribution that the chain leaves as it is, by the elimination of Grassmann et al.

    States are taken out of the chain one by one, from the last on; whatever leads through one is
    added to what leads around it::

        P_ij += P_ik P_kj / sum_(l < k) P_kl        for i, j < k

    Nothing is subtracted, so no digits are lost, however rarely the chain changes its state.

    Raises
    ------
    ValueError
        If the chain has sets of states that never meet, and so more than one such distribution.

    Examples
    --------
    >>> rare = 1e-20
    >>> stationary(np.array([[1.0, rare], [3.0 * rare, 1.0]]))
    array([0.75, 0.25])
    """
    reached = leads_to(P)
    final = np.flatnonzero(reached.all(axis=0))  # states that every state leads to
    if not len(final) and len(P):
        raise ValueError("the chain has states that never meet: no single stationary distribution")
    A = P[np.ix_(final, final)].copy()
    shares = np.zeros(len(P))
    weights = np.ones(len(final))
    for k in range(len(A) - 1, 0, -1):
        A[:k, k] /= A[k, :k].sum()
        A[:k, :k] += np.outer(A[:k, k], A[k, :k])
    for k in range(1, len(A)):
        weights[k] = weights[:k] @ A[:k, k]
    shares[final] = weights / weights.sum()
    return shares


def committor(P: NDArray[np.float64], at_once: NDArray[np.float64]) -> NDArray[np.float64]:
    """(n,) probability that the chain ever ends well, from each state.

    A row of P may sum to less than 1: the chain ends then with the rest of probability, of which
    ``at_once`` (n,) is the part that counts. The least solution of ``q = at_once + P q``.
    """
    may = leads_to(P) @ (at_once > 0.0)
    share = np.zeros(len(P))
    some = np.flatnonzero(may)
    among = np.eye(len(some)) - P[np.ix_(some, some)]
    share[some] = np.linalg.solve(among, at_once[some])
    return np.clip(share, 0.0, 1.0)


def passage_times(P: NDArray[np.float64], targets: NDArray[np.bool_]) -> NDArray[np.float64]:
    """(n,) mean number of steps until the chain is first in one of the targets (n,).

    0 in a target, infinity where it may never get there: ``m = 1 + P m`` elsewhere.
    """
    through = np.where(targets[:, None], 0.0, P)
    lost = ~(leads_to(through) @ targets)
    surely = np.flatnonzero(~(leads_to(through) @ lost) & ~targets)
    times = np.where(targets, 0.0, np.inf)
    among = np.eye(len(surely)) - P[np.ix_(surely, surely)]
    times[surely] = np.linalg.solve(among, np.ones(len(surely)))
    return times
