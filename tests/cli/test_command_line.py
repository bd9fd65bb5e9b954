"""Command lines as they are typed: help, groups, mistakes, and Ctrl-C before anything has begun."""

import re
import subprocess
import sys

import pytest

from mfvpr.cli import groups
from mfvpr.cli.overrides import quote
from mfvpr.systems.settings import CONF
from tests.programs import ROOT, composed, run

pytestmark = pytest.mark.thorough

OWN = ("dataset=folder", "dataset.database=a", "dataset.queries=b")
PROGRAMS = {
    command.removeprefix("mfvpr ").removeprefix("python -m experiments."): config
    for config, (command, _) in groups.PROGRAMS.items()
}


@pytest.mark.parametrize("program", PROGRAMS)
def test_help_has_every_setting_and_the_comments_of_conf(succeed, program):
    stdout, stderr = succeed(program, "--help")
    assert stderr == ""
    pending = [composed(config=PROGRAMS[program])]
    while pending:
        for name, value in pending.pop().items():
            assert re.search(rf"^ *{name}:", stdout, flags=re.MULTILINE), name
            pending += [value] if isinstance(value, dict) else []
    if "common" in groups.defaults(CONF / f"{PROGRAMS[program]}.yaml"):
        text = (CONF / "common.yaml").read_text()
        for line in text[text.index("candidates:") : text.index("hydra:")].splitlines():
            assert line in stdout
        assert "image_size: [336, 336]  # width, height" in stdout
    assert groups.PROGRAMS[PROGRAMS[program]][0] in stdout
    assert "hydra:" not in stdout
    for group in ("system", "experiment"):
        assert (f"  {group}=null" in stdout) == (group in groups.groups(PROGRAMS[program]))


@pytest.mark.parametrize(("argument", "alone", "in_multirun"), [
    ("out=a,b", "out='a,b'", "out='a','b'"), ("dataset.queries=[a,b c]", *["dataset.queries=['a','b c']"] * 2),
    ("candidates=5,10", "candidates=5,10", "candidates=5,10"),
])  # fmt: skip
def test_a_comma_is_part_of_a_path_unless_several_runs_are_asked_for(argument, alone, in_multirun):
    assert (quote(argument), quote(argument, several=True)) == (alone, in_multirun)


def test_help_is_of_the_groups_that_were_chosen(succeed):
    anchor, _ = succeed("sweep", "--help", "experiment=anchor", "dataset=corridor")
    assert "  window: 10.0  # cells" in anchor
    assert "sigma: 22.5" not in anchor
    assert "  num_bins: [10, 15, 20]" in anchor
    assert "  database: ${.root}/ref" in anchor
    assert "  index_file: null" in anchor
    assert "database: ???" not in anchor
    system, _ = succeed("evaluate", "system=mix_hist_10", "-h", "retrieval=vlad")
    assert "  weights: d2_tf  # d2_tf, d2_ots" in system
    assert "  num_words: 64" in system


@pytest.mark.parametrize(("argument", "code", "error", "modules"), [
    ("--help", None, "", ["hydra", "omegaconf", "numpy", "jax"]),
    ("scorer.histogram.sigma=0", 2, "error: scorer.histogram.sigma=0: expected a number from 1e-06 to 1e+12",
     ["numpy", "jax"]),
])  # fmt: skip
def test_help_and_wrong_settings_do_not_wait_for_slow_imports(argument, code, error, modules):
    script = ("import sys; from mfvpr.cli.launch import launch\n"
              f"sys.argv, code = ['evaluate', {argument!r}], None\n"
              "try: launch('config')\n"
              "except SystemExit as left: code = left.code\n"
              f"assert (code, {{*{modules}}} & {{*sys.modules}}) == ({code}, set())")  # fmt: skip
    done = subprocess.run([sys.executable, "-c", script], cwd=ROOT, capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr
    assert done.stderr[: len(error) or None] == error


@pytest.mark.parametrize("program", [*PROGRAMS, "evaluate candidates=3", "benchmark.__main__", "weights"])
def test_version(succeed, program):
    stdout, _ = succeed(program, "--version")
    assert re.fullmatch(r"mfvpr \d+\.\d+\.\d+ \(jax .*, Python .*\)\n", stdout)


@pytest.mark.parametrize(("program", "arguments", "words"), [
    ("evaluate", ["experiment=histogram"], "type mfvpr sweep experiment=histogram"),
    ("sweep", ["system=mix_hist_5"], "the nearest is mix_hist_50"),
    ("sweep", ["system=null"], "leave it out for none"),
    ("sweep", ["system=mix_hist_50"], "grid: expected at least one axis"),
    ("sweep", ["system=mix_hist_comb_10", "experiment=anchor", "grid.sigma=[3]"], "grid.sigma: scorer=anchor has"),
    ("sweep", ["fusion.c=zscore", "final=combined", "grid.sigma=[3]"], "fusion.c=zscore: expected a number or auto"),
    ("sweep", ["scorer=histogram", "grid.c=[zscore]"], "grid.c=['zscore']: expected a list"),
    ("learn", ["fusion.c=zscore"], "fusion.c=auto fusion.weights=null"),
    ("evaluate", ["fusion.c=zscores"], "a number from 0 to 1e+12, or auto, zscore"),
    ("evaluate", ["fusion.weights={retrieval: 2}"], "{'retrieval': 2}: expected fusion.c=zscore"),
    ("evaluate", ["fusion.c=zscore", "fusion.weights={retrieval: 0}"], ".retrieval=0: expected a number"),
    ("evaluate", ["fusion.weights.retrieval=2"], "the nearest is fusion.weights"),
    ("evaluate", ["fusion.c=zscore", "fusion.weights={ancor: 1}"], "fusion.weights: expected retrieval"),
    ("evaluate", ["scorer=sum", "fusion.c=zscore", "fusion.weights={anchor: 1}"], "got anchor; choose scorer=all"),
    ("evaluate", ["candidates =5"], "candidates =5: expected name=value"),
    ("evaluate", ["ü=5"], "ü=5: expected name=value"),
    ("evaluate", ["--cfg", "job"], "--cfg: unknown option"),
    ("evaluate", [f"candidates={'9' * 5000}"], "candidates=99999999999999999999...: expected"),
    ("evaluate", [f"scorer.histogram.sigma={'9' * 299}"], "...: expected a number from 1e-06 to 1e+12"),
    ("evaluate", [f"candidates={'[' * 500}"], "[...: expected a whole number"),
    ("evaluate", ["candidates=1,2"], "candidates=1,2: expected one value"),
    ("evaluate", ["candidates=range(1,3)"], "requires --multirun"),
    ("evaluate", ["candidates=${nope}"], "candidates: Interpolation key 'nope' not found"),
    ("evaluate", ["store=DIR"], "store: unknown setting; its name is cache now"),
    ("evaluate", ["fusion.filter_score=cosine"], "its name is fusion.retrieval_score now"),
    ("evaluate", ["scorer=histogram", "scorer.scales=[1,2]"], "scorer.scales: unknown setting; it was removed"),
    ("evaluate", ["scorer.histogram.scale_deviation=1"], "scale_deviation: unknown setting; it was removed"),
    ("sweep", ["grid.scale_deviation=[1]"], "grid.scale_deviation: unknown setting; it was removed"),
    ("evaluate", ["dataset.cache=null"], "dataset.cache=null: expected a path"),
    ("evaluate", ["cache=${oc.env:NOPE}"], "cache=${oc.env:NOPE}: expected a path"),
    ("evaluate", ["out=runs/${x"], "out=runs/${x: expected a path"),
    ("evaluate", ["retrieval.max_samples=63"], "max_samples=63: expected at least retrieval.num_words=64"),
    ("evaluate", ["matching=lightglue", "matching.filter_threshold=2"], "threshold=2: expected a number from 0 to 1"),
    ("evaluate", ["matching=lightglue", "matching.weights=d2_tf"], "weights=d2_tf: expected weights of lightglue"),
    ("sweep", ["grid.sigma=[1,1.0]"], "grid.sigma=[1, 1.0]: expected different values"),
    ("sweep", ["grid=[1]"], "grid=[1]: this is a group of settings"),
    ("evaluate", ["figures=[1.5]"], "figures=[1.5]: expected how many"),
    ("evaluate", ["candidats=3"], "the nearest is candidates"),
    ("evaluate", ["dataset.database=a"], "dataset=folder and dataset=sequences have dataset."),
    ("evaluate", ["scorer=sum", "scorer.sigma=15"], "scorer=histogram has scorer.sigma"),
    ("evaluate", ["scorer.sigma=15"], "the nearest is scorer.histogram.sigma"),
    ("evaluate", ["retrieval=pairs", "retrieval.file=a"], "the nearest is retrieval.queries"),
    ("evaluate", ["dataset=folder"], "dataset.database: this setting has no default"),
    ("evaluate", [*OWN], "dataset.ground_truth: "),
    ("evaluate", [*OWN, "dataset.ground_truth=none"], "a: expected a folder of images"),
    ("evaluate", ["+new=1"], "+new=1: settings can be set, not added"),
    ("evaluate", ["word"], "word: expected name=value"),
    ("evaluate", ["scorer=[count,sum]"], "expected one of all"),
    ("evaluate", ["features=null"], "aliked, d2net, dinov2, dinov2_attention, import, patch_netvlad, selavpr, sift"),
    ("evaluate", ["scorer.count.method=histogram"], "scorer.count.method=histogram: expected count"),
    ("evaluate", ["scorer=histogram", "scorer.bin_size=[1,2"], "scorer.bin_size=[1,2: expected a number from 1e-06"),
    ("evaluate", ["dataset.name=../up"], "dataset.name=../up: expected letters"),
    ("evaluate", ["scorer=histogram", "scorer.method=sum"], "scorer=sum has no setting"),
    ("evaluate", ["hydra.foo=1"], "hydra.foo: unknown setting; see --help"),
    ("evaluate", [f"out={ROOT}/README.md"], "README.md: expected a new or empty run folder"),
    ("evaluate", ["out=/"], "/: expected a new or empty run folder"),
    ("evaluate", ["out=/dev/null/x"], "/x: cannot be written to (Not a directory)"),
    ("evaluate", ["shard=2/2"], "shard=2/2: expected i/n with i from 0"),
    ("evaluate", ["shard=0/2", "cache=null"], "shard=0/2: expected cache=DIR as well"),
    ("evaluate", ["cluster=local", "cache=null"], "cluster=local: expected cache=DIR as well, a folder that all"),
    ("evaluate", ["cluster.address=HOST"], "cluster.address=HOST: expected tcp://HOST:PORT"),
    ("evaluate", ["cluster.workers=2"], "cluster=local and cluster=slurm have cluster.workers"),
    ("sweep", ["cluster=slurm"], "error: sbatch: No such file or directory"),
    ("evaluate", ["threshold=0.5"], "threshold=0.5: expected confidence=FILE"),
    ("evaluate", ["threshold=2"], "threshold=2: expected a number from 0 to 1"),
    ("evaluate", ["confidence=/none.json"], "/none.json: expected the confidence.json"),
    ("evaluate", ["launcher=joblib"], "launcher=joblib: expected one, and --multirun"),
    ("evaluate", ["-m", "launcher=joblib,slurm"], "launcher=joblib,slurm: expected one, and --multirun"),
    ("evaluate", ["-m", "hydra/launcher=nope"], "nope: this launcher is not installed; there are basic joblib"),
    ("localize", ["map=a", "images=b", "route=-2000"], "route=-2000: expected a number from -1000 to 1000, or null"),
    ("benchmark.__main__", ["foo"], "invalid choice: 'foo'"),
    ("benchmark.__main__", ["--rounds", "0"], "expected a whole number above 0, got 0; see python -m experiments.ben"),
])  # fmt: skip
def test_mistakes_are_one_line_and_leave_nothing(refuse_at_once, program, arguments, words):
    error = refuse_at_once(program, *arguments)
    assert words in error
    assert len(error) < 400


@pytest.mark.slow
def test_a_device_that_is_not_there_is_one_line():
    for name in ("cuda", "nonsense"):
        done = run("candidates=3", JAX_PLATFORMS=name)
        assert done.returncode == 2
        assert f"error: JAX_PLATFORMS={name}: expected a device" in done.stderr
        assert done.stderr.count("\n") == 1


@pytest.mark.parametrize("module", ["yaml", "omegaconf", "jaxlib", "jax"])
def test_ctrl_c_during_imports_is_one_line(tmp_path, interrupt, module):
    command = [sys.executable, "-X", "importtime", "-m", "experiments.evaluate", f"out={tmp_path}/out"]
    process = subprocess.Popen(command, cwd=ROOT, stderr=subprocess.PIPE, text=True)
    for line in process.stderr:
        if line.rpartition("|")[2].strip() == module:
            break
    interrupt(process)
