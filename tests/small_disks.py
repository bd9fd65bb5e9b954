"""Disks of a few megabytes, for tests of what happens when they are full."""

import subprocess

import pytest

from tests.needs import skip_without

UNSHARE = ("unshare", "--map-root-user", "--mount")


def mount(folder, *options):
    """A disk there, or another size of it; in a process that was started with UNSHARE in front."""
    subprocess.run(["mount", "-t", "tmpfs", *options, "none", str(folder)], check=True, capture_output=True)


def need_small_disks(folder):
    """Skip where the kernel does not let this user mount any."""
    command = [*UNSHARE, "mount", "-t", "tmpfs", "none", str(folder)]
    skip_without("unshare")
    if subprocess.run(command, capture_output=True).returncode:
        pytest.skip("needs a user who may mount a small disk")
