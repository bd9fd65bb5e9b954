"""Charts of runs for plotly.js: lines and bars of numbers from the page's tables or the run's files."""

import html
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

from mfvpr.report.plots import COLORS, color_and_dash
from mfvpr.utils.files import printable

_POWERS = [step * 10.0**power for power in range(-4, 4) for step in (1, 2, 5)]
_HEIGHT = 380  # px
_NAMES = {"type": "category", "autorange": "reversed"}  # an axis of names, the first on top

Scale = Literal["linear", "log", "percent"]
_SCALES: dict[Scale, dict[str, Any]] = {
    "linear": {"type": "linear"},
    "log": {"type": "log", "tickvals": [step * 10**power for power in range(6) for step in (1, 2, 5)]},
    "percent": {"type": "linear", "range": [-1, 101]},
}


@dataclass(frozen=True)
class Chart:
    """A chart of a page: plotly's `data` and `layout` as JSON values; `words` are for readers who do not see it."""

    name: str
    title: str
    words: str
    figure: Mapping[str, Any]


@dataclass(frozen=True)
class Bar:
    """A bar's height in %, and its interval where that is known."""

    percent: float
    interval: tuple[float, float] | None = None

    @property
    def interval_words(self) -> str:
        """The interval in a cell; empty if it is not known."""
        return "[{:.1f}, {:.1f}]".format(*self.interval) if self.interval else ""


def line_chart(
    name: str,
    title: str,
    curves: Mapping[str, Sequence[tuple[float, float]]],
    *,
    axes: tuple[str, str],
    scale: Scale = "linear",
    marked: bool = False,
    unit: str = "%",
) -> Chart:
    """A curve of points (x, y) for each name; the others are compared with the first.

    `axes` are words of x and y, `scale` is that of x. Points are `marked` if the curve is known only there. The axis of
    a `unit` other than % is logarithmic.
    """
    form = ".1f" if unit == "%" else ".3g"
    traces = [
        {"type": "scatter", "x": [x for x, _ in points], "y": [y for _, y in points], "name": _escape(label),
         "mode": "lines+markers" if marked else "lines",
         "line": dict(zip(("color", "dash"), color_and_dash(place), strict=True), width=2),
         "hovertemplate": f"%{{x:.4g}}: %{{y:{form}}} {unit}"}
        for place, (label, points) in enumerate(curves.items())
    ]  # fmt: skip
    y_axis = {"range": [-2, 102]} if unit == "%" else {"type": "log", "tickvals": _POWERS}
    ends = (f"{label}: {points[0][1]:{form}} to {points[-1][1]:{form}} {unit}" for label, points in curves.items()
            if points)  # fmt: skip
    words = f"{axes[1]} against {axes[0]}. {'; '.join(ends)}."
    return _chart(name, title, words, traces, axes, _SCALES[scale], y_axis, showlegend=len(curves) > 1)


def bar_chart(name: str, title: str, groups: Mapping[str, Mapping[str, Bar]], *, axis: str) -> Chart:
    """Horizontal bars by the name of a group, which has a color, and of its member; whiskers are intervals.

    Members of a single group have a color each if there are enough colors.
    """
    single, traces = len(groups) == 1, []
    for place, (label, members) in enumerate(groups.items()):
        by_member = single and len(members) <= 1 + len(COLORS)
        colors = [color_and_dash(member)[0] for member in range(len(members))]
        traces.append({
            **_bars({member: bar.percent for member, bar in members.items()}), "name": _escape(label),
            "marker": {"color": colors if by_member else color_and_dash(place + single)[0]},
            "error_x": _whiskers([*members.values()]), "hovertemplate": "%{y}: %{x:.1f} %",
        })  # fmt: skip
    parts = (f"{label}, {member}: {bar.percent:.1f} %" for label, members in groups.items()
             for member, bar in members.items())  # fmt: skip
    height = max(_HEIGHT, 100 + 16 * sum(map(len, groups.values())))
    words = f"{axis}. {'; '.join(parts)}."
    return _chart(name, title, words, traces, (axis, ""), {"range": [0, 102]}, _NAMES, showlegend=not single,
                  height=height)  # fmt: skip


def amount_chart(name: str, title: str, values: Mapping[str, float], *, axis: str) -> Chart:
    """Horizontal bars, one for each name."""
    bars = _bars(values) | {"marker": {"color": COLORS[0]}, "hovertemplate": "%{y}: %{x:.4g}",
                            "texttemplate": "%{x:.3g}", "textposition": "auto"}  # fmt: skip
    parts = "; ".join(f"{label}: {value:.3g}" for label, value in values.items())
    return _chart(name, title, f"{axis}. {parts}.", [bars], (axis, ""), {}, _NAMES, showlegend=False)


def _bars(values: Mapping[str, float]) -> dict[str, Any]:
    return {"type": "bar", "orientation": "h", "x": [*values.values()], "y": [*map(_escape, values)]}


def _escape(text: str) -> str:
    """Escape a label: plotly's labels understand some HTML."""
    return html.escape(printable(text), quote=False)


def _whiskers(members: Sequence[Bar]) -> dict[str, Any]:
    ends = [bar.interval or (bar.percent, bar.percent) for bar in members]
    return {
        "type": "data", "symmetric": False, "thickness": 1.2, "width": 3,
        "visible": any(bar.interval for bar in members),
        "array": [high - bar.percent for (_, high), bar in zip(ends, members, strict=True)],
        "arrayminus": [bar.percent - low for (low, _), bar in zip(ends, members, strict=True)],
    }  # fmt: skip


def _chart(
    name: str, title: str, words: str, traces: Sequence[Mapping[str, Any]], titles: tuple[str, str],
    x_axis: Mapping[str, Any], y_axis: Mapping[str, Any], **layout: Any,
) -> Chart:  # fmt: skip
    """A chart in the layout of all charts; its colors follow the page's."""
    common = {"fixedrange": True, "automargin": True, "zeroline": False}
    x, y = ({**common, **axis, "title": {"text": text, "font": {"size": 13}}}
            for axis, text in zip((x_axis, y_axis), titles, strict=True))  # fmt: skip
    layout = {
        "paper_bgcolor": "rgba(0,0,0,0)", "plot_bgcolor": "rgba(0,0,0,0)", "dragmode": False, "height": _HEIGHT,
        "margin": {"l": 56, "r": 12, "t": 12, "b": 48}, "font": {"family": "system-ui, sans-serif", "size": 13},
        "legend": {"orientation": "h", "yanchor": "bottom", "y": 1.02, "x": 0},
        "hoverlabel": {"namelength": -1}, "barmode": "group", "xaxis": x, "yaxis": y, **layout,
    }  # fmt: skip
    return Chart(name, title, words, {"data": traces, "layout": layout})
