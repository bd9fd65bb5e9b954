"""HTML pages that need no other file and no network: charts, tables and pictures in a template, everything escaped.

Names of images may be anything: they are data.
"""

import html
import json
from base64 import b64encode
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from hashlib import sha256
from io import BytesIO
from pathlib import Path
from typing import Any, Literal, NamedTuple

from mfvpr.datasets.image_reading import open_image
from mfvpr.evaluation.statistics import Estimate
from mfvpr.report.figures import ABOUT
from mfvpr.report.plots import COLORS, color_and_dash
from mfvpr.report.tables import Table
from mfvpr.utils.files import printable, require_replaceable, write_text

# Jinja2 and plotly are imported where they are needed: the rest of the library does not depend on them.
PAGE = "report.html"  # in a run folder
MOST_PICTURES = 60
_PICTURE_WIDTH, _QUALITY = 1000, 75  # px, of JPEG: some 60 kB each
_POLICY = b"default-src 'none'; script-src "  # at the start of every page
_TEMPLATES = Path(__file__).parent / "templates"
_HEIGHT = 380  # px of a chart
_NAMES = {"type": "category", "autorange": "reversed"}  # an axis of names, the first on top
_SCALES: dict[str, dict[str, Any]] = {
    "linear": {"type": "linear"},
    "log": {"type": "log", "tickvals": [step * 10**power for power in range(6) for step in (1, 2, 5)]},
    "percent": {"type": "linear", "range": [-1, 101]},
}


class Chart(NamedTuple):
    """A chart of a page: `data` and `layout` of plotly as JSON values; `words` are for readers who do not see it."""

    name: str
    title: str
    words: str
    figure: Mapping[str, Any]


@dataclass(frozen=True)
class Gallery:
    """Predictions for queries, which can be filtered; `left_out` counts those that the page does not list.

    `shown_system` is chosen at first. `pictures` are of `pictures`, `predictions` of `Run.predictions`.
    """

    shown_system: str
    systems: Sequence[str]
    sequences: Sequence[str]
    pictures: Sequence[Mapping[str, Any]]
    predictions: Sequence[Mapping[str, str]] = ()
    left_out: int = 0


@dataclass(frozen=True)
class Section:
    """A part of a page; `name` is a word for its element, `words` stand above everything in it.

    `tables` are by caption. `links` are words and addresses of other pages, relative to the page. `text` keeps
    its lines. `images` are `data:` URIs by title.
    """

    name: str
    title: str
    words: str = ""
    charts: Sequence[Chart] = ()
    tables: Mapping[str, Table] = field(default_factory=dict)
    gallery: Gallery | None = None
    links: Sequence[tuple[str, str]] = ()
    text: str = ""
    images: Mapping[str, str] = field(default_factory=dict)


def write_page(path: Path, *, title: str, words: str, facts: Mapping[str, str], sections: Sequence[Section]) -> None:
    """Write one HTML file; the same bytes for the same values.

    `words` stand below the title; `facts` are the most important values, by name. An earlier page is replaced; an
    InputError for other files.
    """
    require_replaceable(path, _POLICY)
    from jinja2 import Environment, FileSystemLoader, StrictUndefined
    from markupsafe import Markup
    from plotly.offline import get_plotlyjs

    environment = Environment(loader=FileSystemLoader(_TEMPLATES), autoescape=True, undefined=StrictUndefined)
    environment.trim_blocks = environment.lstrip_blocks = True
    environment.policies["json.dumps_kwargs"] = {"sort_keys": True, "allow_nan": False}
    scripts = [get_plotlyjs(), (_TEMPLATES / "script.js").read_text("utf-8")]
    hashes = [b64encode(sha256(script.encode()).digest()).decode() for script in scripts]
    text = environment.get_template("page.html").render(
        title=title,
        words=words,
        facts=facts,
        sections=sections,
        charts={chart.name: chart.figure for section in sections for chart in section.charts},
        scripts=map(Markup, scripts),  # of this package and of plotly, as is the style
        style=Markup((_TEMPLATES / "style.css").read_text("utf-8")),
        hashes=" ".join(f"'sha256-{each}'" for each in hashes),
    )
    write_text(path, text)


def line_chart(
    name: str,
    title: str,
    curves: Mapping[str, Sequence[tuple[float, float]]],
    *,
    axes: tuple[str, str],
    scale: Literal["linear", "log", "percent"] = "linear",
    marked: bool = False,
) -> Chart:
    """A curve of points (x, y in %) for each name; the others are compared with the first.

    `axes` are words of x and y, `scale` is that of x. Points are `marked` if the curve is known only there.
    """
    traces, ends = [], []
    for place, (label, points) in enumerate(curves.items()):
        color, dash = color_and_dash(place)
        trace = {"type": "scatter", "mode": "lines+markers" if marked else "lines", "name": _escape(label)}
        trace |= {"x": [x for x, _ in points], "y": [y for _, y in points], "hovertemplate": "%{x:.4g}: %{y:.1f} %"}
        traces.append(trace | {"line": {"color": color, "dash": dash, "width": 2}})
        ends.append(f"{label}: {points[0][1]:.1f} to {points[-1][1]:.1f} %")
    words = f"{axes[1]} against {axes[0]}. {'; '.join(ends)}."
    scales = _SCALES[scale], {"range": [-2, 102]}
    return _chart(name, title, words, traces, axes, scales, showlegend=len(curves) > 1)


def bar_chart(name: str, title: str, groups: Mapping[str, Mapping[str, Estimate]], *, axis: str) -> Chart:
    """Horizontal bars in %; a group has a color, a member a place on the axis; whiskers are intervals.

    Members of a single group have a color each if there are enough colors. Intervals without a width are not drawn.
    """
    single, traces, words = len(groups) == 1, [], []
    for place, (label, members) in enumerate(groups.items()):
        colors = [color_and_dash(member)[0] for member in range(len(members))]
        by_member = single and len(members) <= 1 + len(COLORS)
        above = [100 * (bar.interval[1] - bar.recall) for bar in members.values()]
        below = [100 * (bar.recall - bar.interval[0]) for bar in members.values()]
        whiskers = {"type": "data", "symmetric": False, "thickness": 1.2, "width": 3, "array": above}
        trace = _bars({member: 100 * bar.recall for member, bar in members.items()}, "%{y}: %{x:.1f} %")
        trace |= {
            "name": _escape(label),
            "marker": {"color": colors if by_member else color_and_dash(place + single)[0]},
        }
        traces.append(trace | {"error_x": whiskers | {"arrayminus": below, "visible": any(above + below)}})
        words += [f"{label}, {member}: {100 * bar.recall:.1f} %" for member, bar in members.items()]
    layout = {"showlegend": not single, "height": max(_HEIGHT, 100 + 16 * sum(map(len, groups.values())))}
    scales = {"range": [0, 102]}, _NAMES
    return _chart(name, title, f"{axis}. {'; '.join(words)}.", traces, (axis, ""), scales, **layout)


def amount_chart(name: str, title: str, values: Mapping[str, float], *, axis: str) -> Chart:
    """Horizontal bars, one for each name."""
    bars = _bars(values, "%{y}: %{x:.4g}") | {"texttemplate": "%{x:.3g}", "textposition": "auto"}
    bars |= {"marker": {"color": COLORS[0]}}
    parts = "; ".join(f"{label}: {value:.3g}" for label, value in values.items())
    return _chart(name, title, f"{axis}. {parts}.", [bars], (axis, ""), ({}, _NAMES), showlegend=False)


def _bars(values: Mapping[str, float], hover: str) -> dict[str, Any]:
    names = [*map(_escape, values)]
    return {"type": "bar", "orientation": "h", "x": [*values.values()], "y": names, "hovertemplate": hover}


def _escape(text: str) -> str:
    """Escape a label: plotly's labels understand some HTML."""
    return html.escape(printable(text), quote=False)


def _chart(
    name: str, title: str, words: str, traces: Sequence[Any], titles: tuple[str, str], axes: Any, **layout: Any
) -> Chart:
    x, y = ({**axis, "title": {"text": text}} for axis, text in zip(axes, titles, strict=True))
    return Chart(name, title, words, {"data": traces, "layout": {"height": _HEIGHT, "xaxis": x, "yaxis": y, **layout}})


def values_table(values: Mapping[str, Any]) -> Table:
    """Nested values by their dotted names."""
    return Table(["name", "value"], [*map(list, flat(values))], text_columns=2)


def flat(values: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    """Nested values as (dotted name, text)."""
    for name, value in values.items():
        if isinstance(value, Mapping) and value:
            yield from ((f"{name}.{inner}", text) for inner, text in flat(value))
        else:
            yield name, value if isinstance(value, str) else json.dumps(value, ensure_ascii=False)


def embed(path: Path) -> str:
    """A PNG file as a `data:` URI."""
    return f"data:image/png;base64,{b64encode(path.read_bytes()).decode()}"


def pictures(run: Path, *, most: int = MOST_PICTURES) -> list[dict[str, Any]]:
    """Figures of queries and their predictions, by their files; evenly chosen if there are more than `most`.

    A picture has the values of the keywords `ABOUT`, its `source` as a `data:` URI, and its `size`, px.
    """
    paths, shown = sorted((run / "figures").rglob("*_[0-9]*.png")), list[dict[str, Any]]()
    for path in paths[:: max(1, -(-len(paths) // most))]:
        with open_image(path) as image:
            image.load()
            if not {*ABOUT} <= {*image.info}:
                continue  # a figure of something else
            small, file = image.convert("RGB"), BytesIO()
        small.thumbnail((_PICTURE_WIDTH, small.height))
        small.save(file, "JPEG", quality=_QUALITY, optimize=True)
        source = f"data:image/jpeg;base64,{b64encode(file.getvalue()).decode()}"
        about = {name: str(image.info[name]) for name in ABOUT}
        shown.append(about | {"source": source, "size": small.size})
    return shown
