"""Maps of buildings, refined: how good they become, how long it takes."""
