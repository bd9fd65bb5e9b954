"""Parts of a page, and pages from their template: everything escaped and embedded, without any network access."""

from base64 import b64encode
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from hashlib import sha256
from pathlib import Path

from mfvpr.report.pages.charts import Chart
from mfvpr.report.pages.files import Prediction
from mfvpr.report.pages.pictures import Picture
from mfvpr.report.tables import Table
from mfvpr.utils.files import write_text

# Jinja2 and plotly are imported where they are needed: the rest of the library does not depend on them.
_TEMPLATES = Path(__file__).parent / "templates"


@dataclass(frozen=True)
class Gallery:
    """Predictions for queries, which can be filtered; `left_out` counts those that the page does not list."""

    system: str
    systems: Sequence[str]
    sequences: Sequence[str]
    pictures: Sequence[Picture]
    predictions: Sequence[Prediction] = ()
    left_out: int = 0

    @property
    def outcomes(self) -> list[str]:
        """Outcomes that occur."""
        return sorted({shown.outcome for shown in (*self.pictures, *self.predictions)})


@dataclass(frozen=True)
class Section:
    """A part of a page; `name` is a word for its element, `words` stand above everything in it.

    `tables` are by caption. `links` are words and the addresses of other pages, relative to the page.
    """

    name: str
    title: str
    words: str = ""
    charts: Sequence[Chart] = ()
    tables: Mapping[str, Table] = field(default_factory=dict)
    gallery: Gallery | None = None
    links: Sequence[tuple[str, str]] = ()


def write_page(path: Path, *, title: str, words: str, facts: Mapping[str, str], sections: Sequence[Section]) -> None:
    """Write one HTML file that needs no other; the same bytes for the same values.

    `words` stand below the title; `facts` are the most important values, by name.
    """
    from jinja2 import Environment, FileSystemLoader, StrictUndefined
    from markupsafe import Markup
    from plotly.offline import get_plotlyjs

    environment = Environment(
        loader=FileSystemLoader(_TEMPLATES), autoescape=True, undefined=StrictUndefined, trim_blocks=True,
        lstrip_blocks=True,
    )  # fmt: skip
    environment.policies["json.dumps_kwargs"] = {"sort_keys": True, "allow_nan": False}
    scripts = [get_plotlyjs(), (_TEMPLATES / "script.js").read_text("utf-8")]
    text = environment.get_template("page.html").render(
        title=title, words=words, facts=facts, sections=sections,
        charts={chart.name: chart.figure for section in sections for chart in section.charts},
        scripts=[Markup(script) for script in scripts],  # of this package and of plotly, as is the style
        style=Markup((_TEMPLATES / "style.css").read_text("utf-8")),
        hashes=" ".join(f"'sha256-{b64encode(sha256(script.encode()).digest()).decode()}'" for script in scripts),
    )  # fmt: skip
    write_text(path, text)
