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
from mfvpr.report.plots import color_and_dash
from mfvpr.report.tables import Table
from mfvpr.utils.files import printable, require_replaceable, write_text

# Jinja2 and plotly are imported where they are needed: the rest of the library does not depend on them.
PAGE = "report.html"  # in a run folder
_MOST_PICTURES = 60
_PICTURE_WIDTH, _QUALITY = 1000, 75  # px, of JPEG: some 60 kB each
_POLICY = b"default-src 'none'; script-src "  # at the start of every page
_TEMPLATES = Path(__file__).parent / "templates"


class Chart(NamedTuple):
    """A chart of a page: script.js draws `figure`."""

    name: str
    title: str
    figure: Mapping[str, Any]


@dataclass(frozen=True)
class Section:
    """A part of a page; `name` is a word for its element, `words` stand above everything in it.

    `tables` are by caption, `images` `data:` URIs by title, `links` words and relative addresses of other pages. `text`
    keeps its lines. `pictures` (of `pictures`) and `predictions` (of `Run.predictions`) can be filtered.
    """

    name: str
    title: str
    words: str = ""
    charts: Sequence[Chart] = ()
    tables: Mapping[str, Table] = field(default_factory=dict)
    links: Sequence[tuple[str, str]] = ()
    text: str = ""
    images: Mapping[str, str] = field(default_factory=dict)
    pictures: Sequence[Mapping[str, Any]] = ()
    predictions: Sequence[Mapping[str, str]] = ()


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
    scale: Literal["linear", "log", "percent"],
) -> Chart:
    """A curve of points (x, y in %) for each name; the others are compared with the first.

    `axes` are words of x and y, `scale` is that of x.
    """
    traces = []
    for place, (label, points) in enumerate(curves.items()):
        color, dash = color_and_dash(place)
        x, y = zip(*points, strict=True)
        traces.append({"name": _escape(label), "x": x, "y": y, "line": {"color": color, "dash": dash, "width": 2}})
    return Chart(name, title, {"kind": "lines", "scale": scale, "axes": axes, "data": traces})


def bar_chart(name: str, title: str, groups: Mapping[str, Mapping[str, Estimate]], *, axis: str) -> Chart:
    """Horizontal bars in % with their intervals; a group has a color, a member a place on the axis.

    Members of a single group have a color each.
    """
    traces = []
    for place, (label, members) in enumerate(groups.items()):
        colors = [color_and_dash(number)[0] for number in range(len(members))]
        above = [100 * (bar.interval[1] - bar.recall) for bar in members.values()]
        below = [100 * (bar.recall - bar.interval[0]) for bar in members.values()]
        trace = {"name": _escape(label), "y": [*map(_escape, members)]}
        trace |= {"x": [100 * bar.recall for bar in members.values()]}
        trace |= {"marker": {"color": colors if len(groups) == 1 else color_and_dash(place)[0]}}
        traces.append(trace | {"error_x": {"array": above, "arrayminus": below}})
    return Chart(name, title, {"kind": "bars", "scale": "share", "axes": (axis, ""), "data": traces})


def _escape(text: str) -> str:
    """Escape a label: plotly's labels understand some HTML."""
    return html.escape(printable(text), quote=False)


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


def pictures(run: Path) -> list[dict[str, Any]]:
    """Figures of queries and their predictions, by their files; evenly chosen if there are many.

    A picture has the values of the keywords `ABOUT`, its `source` as a `data:` URI, and its `size`, px.
    """
    paths, shown = sorted((run / "figures").rglob("*_[0-9]*.png")), list[dict[str, Any]]()
    for path in paths[:: max(1, -(-len(paths) // _MOST_PICTURES))]:
        with open_image(path) as image:
            image.load()
            about, small, file = {name: str(image.info[name]) for name in ABOUT}, image.convert("RGB"), BytesIO()
        small.thumbnail((_PICTURE_WIDTH, small.height))
        small.save(file, "JPEG", quality=_QUALITY, optimize=True)
        source = f"data:image/jpeg;base64,{b64encode(file.getvalue()).decode()}"
        shown.append(about | {"source": source, "size": small.size})
    return shown
