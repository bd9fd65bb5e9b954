"""Hydra's multirun: many jobs, one after the other or at the same time."""

import hydra
import pytest
from hydra.core.config_store import ConfigStore
from hydra.core.plugins import Plugins

from mfvpr.cli import schema
from mfvpr.systems.assembly import CONF
from tests.needs import reason
from tests.programs import composed, csv_rows, results, run, small

SIGMA = "grid.sigma=[10]"


@pytest.mark.slow
def test_a_multirun_makes_one_run_folder_per_job(root, tmp_path, monkeypatch, call, succeed):
    monkeypatch.chdir(tmp_path)
    jobs = ("experiment=weight", "scorer=sum,histogram", "candidates=8,0")
    code, stdout, stderr = call("sweep", "-m", *small(root), *jobs)
    assert code == 2
    folders = sorted((tmp_path / "runs" / "folder").iterdir())
    assert [f"results: {path.relative_to(tmp_path)}" in stdout for path in folders] == [True, True]
    assert {results(path)["scorer"]["method"] for path in folders} == {"sum", "histogram"}
    assert stderr.splitlines()[-1].startswith("error: candidates=0: expected ")
    assert "Traceback" not in stderr
    assert [number for number in range(4) if f"job {number}: " in stderr] == [0, 1, 2, 3]
    [joint] = (tmp_path / "runs" / "multirun").iterdir()
    lines = csv_rows(joint / "table.csv")
    assert [(line["job"], line["scorer"]) for line in lines] == [("0", "sum"), ("2", "histogram")]
    for line in lines:
        content = results(tmp_path / line["run"])
        assert line["system"] == content["scorer"]["method"] == line["scorer"]
        for verdict in content["report"]:
            assert float(line[f"R@1 ±{verdict['threshold']}"]) == round(100 * verdict["chosen"]["recall"], 1)
    assert (joint / "table.md").exists()
    stdout, _ = succeed("report", joint)
    assert lines[0]["run"] in (joint / "report.html").read_text()


@pytest.mark.slow
def test_a_joint_table_has_a_line_per_job_and_system(root, tmp_path, monkeypatch, succeed):
    monkeypatch.chdir(tmp_path)
    succeed("evaluate", "-m", *small(root), "figures=0", "scorer=sum", "candidates=4,8")
    [joint] = (tmp_path / "runs" / "multirun").iterdir()
    lines = csv_rows(joint / "table.csv")
    assert [line["candidates"] for line in lines] == ["4", "4", "4", "8", "8", "8"]
    for number in (0, 3):
        rows = csv_rows(tmp_path / lines[number]["run"] / "table.csv")
        for line, row in zip(lines[number:], rows, strict=False):
            assert row.items() <= line.items()


@pytest.mark.slow
def test_jobs_in_several_processes(root, tmp_path):
    jobs = ("launcher=joblib", "hydra.launcher.n_jobs=2", "candidates=4,8", f"cache={tmp_path}/store", SIGMA)
    done = run("-m", *small(root), *jobs, program="sweep", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("results: runs/folder/") == 2
    assert {results(path)["candidates"] for path in (tmp_path / "runs" / "folder").iterdir()} == {4, 8}
    assert "error" not in done.stderr


@pytest.mark.parametrize(("launcher", "plugin"), [
    ("joblib", "joblib"), ("submitit_local", "submitit_local"), ("slurm", "submitit_slurm"),
])  # fmt: skip
def test_a_launcher_composes_and_adds_no_setting(launcher, plugin):
    """Check a structured configuration, which refuses what the plugin does not know."""
    Plugins.instance()
    if f"{plugin}.yaml" not in ConfigStore.instance().repo["hydra"]["launcher"]:
        pytest.skip(reason("hydra_{}_launcher".format(plugin.split("_")[0])))
    for config in ("evaluate", "sweep", "learn"):
        schema.register()
        with hydra.initialize_config_dir(str(CONF), version_base="1.3"):
            hydra_settings = hydra.compose(config, [f"launcher={launcher}"], return_hydra_config=True).hydra
        assert hydra_settings.job.env_set == {"PJRT_NPROC": str(hydra_settings.launcher.get("cpus_per_task") or 1)}
        assert plugin.rpartition("_")[2] in hydra_settings.launcher._target_.lower()
        assert composed(f"launcher={launcher}", config=config) == composed(config=config)
