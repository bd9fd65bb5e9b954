"""Launchers of jobs: they compose, what is not installed is told, and shards go through one."""

import hydra
import pytest
from hydra.core.config_store import ConfigStore
from hydra.core.plugins import Plugins

from mfvpr.cli import schema
from mfvpr.systems.choices import CONF
from tests.needs import reason
from tests.programs import composed

PLUGINS = {"joblib": "joblib", "submitit_local": "submitit_local", "slurm": "submitit_slurm"}  # their launchers
EXTRAS = {"joblib": "sweep", "submitit_local": "slurm", "slurm": "slurm"}


def installed():
    """The launchers that Hydra finds; it looks for them once."""
    Plugins.instance()
    return ConfigStore.instance().repo["hydra"]["launcher"]


@pytest.mark.parametrize("launcher", PLUGINS)
def test_a_launcher_composes_and_adds_no_setting(launcher):
    """Check a structured configuration, which refuses what the plugin does not know."""
    if f"{PLUGINS[launcher]}.yaml" not in installed():
        pytest.skip(reason("hydra_{}_launcher".format(PLUGINS[launcher].split("_")[0])))
    for config in ("evaluate", "sweep", "learn"):
        schema.register()
        with hydra.initialize_config_dir(str(CONF), version_base="1.3"):
            hydra_settings = hydra.compose(config, [f"launcher={launcher}"], return_hydra_config=True).hydra
        assert hydra_settings.job.env_set == {"PJRT_NPROC": str(hydra_settings.launcher.get("cpus_per_task") or 1)}
        assert PLUGINS[launcher].rpartition("_")[2] in hydra_settings.launcher._target_.lower()
        assert composed(f"launcher={launcher}", config=config) == composed(config=config)


@pytest.mark.parametrize("launcher", PLUGINS)
def test_what_is_not_installed_is_told_in_one_line(launcher, monkeypatch, refuse_at_once):
    monkeypatch.delitem(installed(), f"{PLUGINS[launcher]}.yaml", raising=False)
    error = refuse_at_once("evaluate", "-m", f"launcher={launcher}", "candidates=4,8")
    assert f"Could not find 'hydra/launcher/{PLUGINS[launcher]}'" in error
