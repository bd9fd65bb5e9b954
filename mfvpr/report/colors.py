"""Colors and dashes of systems: the same in the figures of a run folder and in its page."""

COLORS = ("#0b84c6", "#e1701a", "#1a9e6f", "#c9559d", "#9a7bd0", "#b58900", "#d1495b", "#5f9ea0")  # on dark and light
_FIRST = "#8a8f98"  # of what all others are compared with
_DASHES = ("solid", "dash", "dot", "dashdot")  # told apart without colors, too


def color_and_dash(place: int) -> tuple[str, str]:
    """Color and plotly's name of the dash of the system at a place of the table."""
    if place == 0:
        return _FIRST, "solid"
    return COLORS[(place - 1) % len(COLORS)], _DASHES[(place - 1) // len(COLORS) % len(_DASHES)]
