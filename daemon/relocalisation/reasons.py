"""Why a place is not sure, in words."""

from __future__ import annotations

from ceilvo.daemon.relocalisation.place_belief import PlaceBelief

AMBIGUOUS, NOT_THIS_MAP = "ambiguous", "not this map"
"""How the reason begins while several places of the map are likely, and while none is."""
TO_CONFIRM = "to be confirmed by landmarks"
ALIKE = 0.05
"""Share of the belief from which a place is named among those that look alike; chosen."""
NOWHERE = 0.01
"""Share that all places of the map have together at most when it is said that the robot is at none. It is a word, not a
decision: the map stays. Renovated rooms fell below it within 10 s in 5 of 6; at a hundredth of it, in 1 of 6. Robots
that were started elsewhere on their map and one that rocks stayed above, but for the views of their first spot."""


def in_words(belief: PlaceBelief, why: str, *, weighed: bool) -> str:
    """The reason for people.

    Args:
        why: what began the doubt.
        weighed: views have been weighed since.
    """
    alike = belief.alike(ALIKE)
    if weighed and alike > 1:
        return f"{AMBIGUOUS}: {alike} places of the map look like this one; {why}"
    if weighed and belief.left_a_spot and belief.on_map() < NOWHERE:
        return f"{NOT_THIS_MAP}: nowhere on it is what is seen: new ground, renovated, or another building; {why}"
    return f"{TO_CONFIRM}: {why}"


def cause(doubt: str) -> str:
    """What tells one such reason from the next: while it stays the state's reason does."""
    return next((c for c in (AMBIGUOUS, NOT_THIS_MAP) if doubt.startswith(c)), "in doubt")
