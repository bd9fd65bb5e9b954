"""Pages from their template: everything escaped, everything embedded, and no network that anything could reach."""

from base64 import b64encode
from collections.abc import Mapping, Sequence
from hashlib import sha256
from pathlib import Path

from mfvpr.report.pages.sections import Section
from mfvpr.utils.files import write_text

# Jinja2 and plotly are imported where they are needed, since everything else can do without.
_TEMPLATES = Path(__file__).parent / "templates"


def write_page(
    path: Path, *, title: str, words: str, facts: Mapping[str, str], sections: Sequence[Section]
) -> None:  # fmt: skip
    """One HTML file that needs no other; the same bytes for the same values.

    Args:
        path: of the page.
        title: of it.
        words: below its title.
        facts: what matters most, by name.
        sections: the parts, in their order.
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
    charts = {chart.name: chart.figure for section in sections for chart in section.charts}
    text = environment.get_template("page.html").render(
        title=title, words=words, facts=facts, sections=sections, charts=charts,
        scripts=[Markup(script) for script in scripts],  # ours and plotly's, as is the style: none of it is foreign
        style=Markup((_TEMPLATES / "style.css").read_text("utf-8")),
        hashes=" ".join(f"'sha256-{b64encode(sha256(one.encode()).digest()).decode()}'" for one in scripts),
    )  # fmt: skip
    write_text(path, text)
