"""Parts of a page, and pages from their template: everything escaped and embedded, without any network access."""

import json
from base64 import b64encode
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from hashlib import sha256
from io import BytesIO
from pathlib import Path
from typing import Any

from PIL import Image

from mfvpr.datasets.image_reading import open_image
from mfvpr.report.figures import ABOUT
from mfvpr.report.pages.charts import Chart
from mfvpr.report.tables import Table
from mfvpr.utils.errors import InputError
from mfvpr.utils.files import require_replaceable, write_text

# Jinja2 and plotly are imported where they are needed: the rest of the library does not depend on them.
PAGE = "report.html"  # in a run folder
MOST_PICTURES = 60
_WIDTH, _QUALITY = 1000, 75  # px of a picture, of JPEG: some 60 kB each
_POLICY = b"default-src 'none'; script-src "  # at the start of every page
_TEMPLATES = Path(__file__).parent / "templates"


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

    `tables` are by caption. `links` are words and the addresses of other pages, relative to the page. `text` keeps
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
    """Write one HTML file that needs no other; the same bytes for the same values.

    `words` stand below the title; `facts` are the most important values, by name. An earlier page is replaced; an
    InputError for other files.
    """
    require_replaceable(path, _POLICY)
    from jinja2 import Environment, FileSystemLoader, StrictUndefined
    from markupsafe import Markup
    from plotly.offline import get_plotlyjs

    loader = FileSystemLoader(_TEMPLATES)
    environment = Environment(
        loader=loader, autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
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


def embed(path: Path) -> str:
    """A PNG file as a `data:` URI."""
    return f"data:image/png;base64,{b64encode(path.read_bytes()).decode()}"


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


def pictures(run: Path, *, most: int = MOST_PICTURES) -> list[dict[str, Any]]:
    """Figures of queries and their predictions, by their files; evenly chosen if there are more than `most`.

    A picture has the values of the keywords `ABOUT`, its `source` as a `data:` URI, and its `size`, px.
    """
    paths, shown = sorted((run / "figures").rglob("*_[0-9]*.png")), list[dict[str, Any]]()
    for path in paths[:: max(1, -(-len(paths) // most))]:
        try:
            with open_image(path) as image:
                image.load()
                small = image.convert("RGB")
        except (OSError, ValueError, SyntaxError, Image.DecompressionBombError) as error:
            raise InputError(f"{path}: expected a figure of the run ({error}); remove it, or run again") from None
        if {*ABOUT} <= {*image.info}:
            small.thumbnail((_WIDTH, small.height))
            file = BytesIO()
            small.save(file, "JPEG", quality=_QUALITY, optimize=True)
            source = f"data:image/jpeg;base64,{b64encode(file.getvalue()).decode()}"
            about = {name: str(image.info[name]) for name in ABOUT}
            shown.append(about | {"source": source, "size": small.size})
    return shown
