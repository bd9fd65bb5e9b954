"""Pages: their commands, code, links and names of settings are run and checked."""

import re
import shlex
import shutil
import subprocess
import sys

import pytest
from PIL import Image

from mfvpr.cli import schema
from mfvpr.cli.command_line import compose_data_sets, with_paths_as_settings
from mfvpr.cli.programs import COMMANDS as PROGRAMS
from mfvpr.systems.assembly import CONF, GROUPS, choices_of
from mfvpr.utils.fields import settings_of
from notebooks.draw_results import draw, query_times, real_recall
from tests import programs
from tests.needs import needs
from tests.programs import QUICK, ROOT, typed

pytestmark = needs("experiments")

README = "README.md"
PAGES = {
    str(path.relative_to(ROOT)): path.read_text()
    for pattern in (README, "conf/*.md", "experiments/*.md", "mfvpr/*/README.md")
    for path in sorted(ROOT.glob(pattern))
}
RESULTS = PAGES.get("experiments/results.md", "")
CONFIGS = {"mfvpr evaluate": "evaluate", "mfvpr sweep": "sweep", "mfvpr learn": "learn", "mfvpr map build": "map",
           "mfvpr localize": "localize", "python -m experiments.paper": "paper"}  # fmt: skip
PLACEHOLDERS = r"\b(?:DATABASE|QUERIES|MAP|IMAGES|DIR|FILE|IMAGE|RUN|NAME)\b"


def blocks(page, language):
    return re.findall(rf"^```{language}\n(.*?)^```", PAGES[page], flags=re.DOTALL | re.MULTILINE)


COMMANDS = [(page, line) for page in PAGES for block in blocks(page, "sh") for line in block.splitlines()]
SETTINGS = [(line, config) for _, line in COMMANDS for start, config in CONFIGS.items() if line.startswith(start)]


def test_commands_exist():
    for page, line in COMMANDS:
        first, second, *_ = line.split()
        if first == "make":
            subprocess.run(["make", "--dry-run", second], cwd=ROOT, capture_output=True, check=True)
        elif first == "mfvpr":
            assert second in PROGRAMS, (page, line)
        else:
            assert line.startswith(("pip install", "python -m experiments.", ". .venv/bin/activate")), (page, line)


@pytest.mark.parametrize(("command", "config"), SETTINGS)
def test_settings_of_commands_are_valid(command, config):
    arguments = shlex.split(re.sub(PLACEHOLDERS, "root", command))[len(command_words(config)) :]
    if "--help" in arguments:
        return
    chosen = [each for each in arguments if each != "-m" and not each.startswith(("launcher=", "cluster"))]
    if "-m" in arguments:  # the first of several values
        chosen = [re.sub(r"=(\[[^]]*\]|[^,\[]*),.*", r"=\1", each) for each in chosen]
    if chosen[:2] == ["root", "root"] and config != "localize" and "ground_truth" not in command:
        chosen.append("ground_truth=order")
    settings = programs.settings_of(*with_paths_as_settings(config, chosen), config=config)
    for name in ("also", "report"):
        assert not getattr(settings, name, None) or compose_data_sets(getattr(settings, name))


def command_words(config):
    [start] = [start for start, name in CONFIGS.items() if name == config]
    return start.split()


@pytest.mark.slow
def test_the_first_command_of_the_readme_runs(small_street, tmp_path, monkeypatch, capsys):
    [command] = [line for page, line in COMMANDS if page == README and line.startswith("mfvpr evaluate")]
    places = {side.upper(): small_street / side for side in ("database", "queries")}
    arguments = [places.get(argument, argument) for argument in shlex.split(command)[2:]]
    monkeypatch.chdir(tmp_path)
    code, stdout, stderr = typed(monkeypatch, capsys, "evaluate", *arguments, *QUICK)
    assert code == 0, stderr
    assert "histogram" in stdout


@pytest.mark.slow
@pytest.mark.parametrize("page", [page for page in PAGES if blocks(page, "python")])
def test_code_runs(page, small_street, tmp_path):
    """The blocks of a page, one after the other, as one script."""
    for side in ("database", "queries"):
        shutil.copytree(small_street / side, tmp_path / side)
    for side, name in (("queries", "query.jpg"), ("database", "candidate.jpg")):
        shutil.copy(small_street / side / "0004.png", tmp_path / name)
    Image.new("L", (320, 240), 255).save(tmp_path / "hood.png")
    script = tmp_path / "page.py"
    script.write_text("\n".join(blocks(page, "python")))
    done = subprocess.run([sys.executable, script], cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    if page == README:
        assert {"run", "map", "report.html"} <= {path.name for path in tmp_path.iterdir()}


@pytest.mark.parametrize("page", PAGES)
def test_links_lead_somewhere(page):
    for target in re.findall(r"\]\(([^)\s]+)\)", PAGES[page]):
        path, _, anchor = target.partition("#")
        if path.startswith("https://"):
            continue
        file = (ROOT / page).parent / path if path else ROOT / page
        assert file.exists(), target
        if anchor:
            headings = re.findall(r"^#+ (.*)$", file.read_text(), flags=re.MULTILINE)
            assert anchor in {slug(heading) for heading in headings}, target


def slug(heading):
    return re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-")


def test_settings_that_pages_name_exist():
    text = re.sub(r"`hydra\.[^`]*`|`\w+=(?:True|False)`", "", "".join(PAGES.values()))  # of Hydra, and of Python
    names = re.findall(r"`(?:[\w.]+\.)?([a-z]\w*)=[^`(]*`", text)
    assert len(names) > 20
    groups = {path.name for path in CONF.iterdir() if path.is_dir()} | {*GROUPS, "cluster", "name"}
    known = set()
    for owner in schema.PROGRAMS.values():
        members = settings_of(owner)
        known |= {*members} | {name for each in members.values() if isinstance(each, dict) for name in each}
    known |= {name for group in GROUPS for each in choices_of(group).values() for name in each}
    known |= {name for owner in schema.OTHERS for name in settings_of(owner)}
    assert {*names} <= known | groups


def test_pages_name_no_machine_path():
    assert not re.search(r"/(work|tmp|root|home)/", "".join(PAGES.values()))


def test_pictures_are_drawn_from_the_tables(tmp_path):
    assert real_recall(RESULTS)["system=mfvpr"] == {"SIFT": [53.5, 71.2], "ALIKED": [90.1, 86.5]}
    assert query_times(RESULTS)["map, SIFT, candidates from memory"] == [[1000.0, 62.6], [10_000.0, 67.6]]
    draw(RESULTS, tmp_path)
    assert {path.name for path in tmp_path.iterdir()} == {"recall.png", "database_size.png", "candidates.png"}
