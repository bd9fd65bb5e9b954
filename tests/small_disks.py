"""Disks of a few megabytes, for tests of what happens when they are full."""

import shutil
import subprocess

import pytest

UNSHARE = ("unshare", "--map-root-user", "--mount")


def mount(folder, *options):
    """A disk there, or another size of it; in a process that was started with UNSHARE in front."""
    subprocess.run(["mount", "-t", "tmpfs", *options, "none", str(folder)], check=True, capture_output=True)


def need_small_disks(folder):
    """Skip where the kernel does not let this user mount any."""
    command = [*UNSHARE, "mount", "-t", "tmpfs", "none", str(folder)]
    if not shutil.which("unshare") or subprocess.run(command, capture_output=True).returncode:
        pytest.skip("the kernel does not let this user mount a small disk")
