"""Charts for plotly.js, of numbers from the page's tables or the run's files; `script.js` has their common layout."""

import html
from collections.abc import Mapping, Sequence
from typing import Any, Literal, NamedTuple

from mfvpr.evaluation.statistics import Estimate
from mfvpr.report.plots import COLORS, color_and_dash
from mfvpr.utils.files import printable

_TICKS = [step * 10.0**power for power in range(-4, 6) for step in (1, 2, 5)]
_HEIGHT = 380  # px
_NAMES = {"type": "category", "autorange": "reversed"}  # an axis of names, the first on top
_SCALES: dict[str, dict[str, Any]] = {
    "linear": {"type": "linear"},
    "log": {"type": "log", "tickvals": _TICKS},
    "percent": {"type": "linear", "range": [-1, 101]},
}


class Chart(NamedTuple):
    """A chart of a page: plotly's `data` and `layout` as JSON values; `words` are for readers who do not see it."""

    name: str
    title: str
    words: str
    figure: Mapping[str, Any]


def line_chart(
    name: str,
    title: str,
    curves: Mapping[str, Sequence[tuple[float, float]]],
    *,
    axes: tuple[str, str],
    scale: Literal["linear", "log", "percent"] = "linear",
    marked: bool = False,
    unit: str = "%",
) -> Chart:
    """A curve of points (x, y) for each name; the others are compared with the first.

    `axes` are words of x and y, `scale` is that of x. Points are `marked` if the curve is known only there. The axis of
    a `unit` other than % is logarithmic.
    """
    form, traces, ends = ".1f" if unit == "%" else ".3g", [], []
    for place, (label, points) in enumerate(curves.items()):
        color, dash = color_and_dash(place)
        trace = {"type": "scatter", "mode": "lines+markers" if marked else "lines", "name": _escape(label)}
        trace |= {"x": [x for x, _ in points], "y": [y for _, y in points]}
        trace |= {"line": {"color": color, "dash": dash, "width": 2}}
        traces.append(trace | {"hovertemplate": f"%{{x:.4g}}: %{{y:{form}}} {unit}"})
        ends += [f"{label}: {points[0][1]:{form}} to {points[-1][1]:{form}} {unit}"] if points else []
    y_axis = {"range": [-2, 102]} if unit == "%" else _SCALES["log"]
    words = f"{axes[1]} against {axes[0]}. {'; '.join(ends)}."
    return _chart(name, title, words, traces, axes, (_SCALES[scale], y_axis), showlegend=len(curves) > 1)


def bar_chart(name: str, title: str, groups: Mapping[str, Mapping[str, Estimate]], *, axis: str) -> Chart:
    """Horizontal bars in % by the name of a group, which has a color, and of its member; whiskers are intervals.

    Members of a single group have a color each if there are enough colors. Intervals without a width are not drawn.
    """
    single, traces, words = len(groups) == 1, [], []
    for place, (label, members) in enumerate(groups.items()):
        by_member = single and len(members) <= 1 + len(COLORS)
        colors = [color_and_dash(member)[0] for member in range(len(members))]
        above = [100 * (bar.interval[1] - bar.recall) for bar in members.values()]
        below = [100 * (bar.recall - bar.interval[0]) for bar in members.values()]
        whiskers = {"type": "data", "symmetric": False, "thickness": 1.2, "width": 3, "array": above}
        trace = _bars({member: 100 * bar.recall for member, bar in members.items()}, "%{y}: %{x:.1f} %")
        trace |= {"marker": {"color": colors if by_member else color_and_dash(place + single)[0]}}
        trace |= {"error_x": whiskers | {"arrayminus": below, "visible": any(above + below)}}
        traces.append(trace | {"name": _escape(label)})
        words += [f"{label}, {member}: {100 * bar.recall:.1f} %" for member, bar in members.items()]
    height = max(_HEIGHT, 100 + 16 * sum(map(len, groups.values())))
    axes, layout = ({"range": [0, 102]}, _NAMES), {"showlegend": not single, "height": height}
    return _chart(name, title, f"{axis}. {'; '.join(words)}.", traces, (axis, ""), axes, **layout)


def amount_chart(name: str, title: str, values: Mapping[str, float], *, axis: str) -> Chart:
    """Horizontal bars, one for each name."""
    bars = _bars(values, "%{y}: %{x:.4g}") | {"marker": {"color": COLORS[0]}}
    bars |= {"texttemplate": "%{x:.3g}", "textposition": "auto"}
    parts = "; ".join(f"{label}: {value:.3g}" for label, value in values.items())
    return _chart(name, title, f"{axis}. {parts}.", [bars], (axis, ""), ({}, _NAMES), showlegend=False)


def _bars(values: Mapping[str, float], hover: str) -> dict[str, Any]:
    names = [*map(_escape, values)]
    return {"type": "bar", "orientation": "h", "x": [*values.values()], "y": names, "hovertemplate": hover}


def _escape(text: str) -> str:
    """Escape a label: plotly's labels understand some HTML."""
    return html.escape(printable(text), quote=False)


def _chart(
    name: str,
    title: str,
    words: str,
    traces: Sequence[Mapping[str, Any]],
    titles: tuple[str, str],
    axes: tuple[Mapping[str, Any], Mapping[str, Any]],
    **layout: Any,
) -> Chart:
    x, y = ({**axis, "title": {"text": text}} for axis, text in zip(axes, titles, strict=True))
    return Chart(name, title, words, {"data": traces, "layout": {"height": _HEIGHT, "xaxis": x, "yaxis": y, **layout}})
