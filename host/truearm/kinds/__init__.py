"""Kinds of observation. Each is a module of this package with a ``KIND``, listed here by name."""

NAMES = (  # in the order of their unknowns in a parameter vector
    "ball_bar",
    "seat",
    "line",
    "position",
    "pose",
    "plane",
)
