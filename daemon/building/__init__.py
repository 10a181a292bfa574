"""Maps of buildings from many drives: refined, joined, built from recordings."""
