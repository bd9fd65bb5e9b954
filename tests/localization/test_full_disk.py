"""A map on a disk that is full while images are added: told in one line, and what was added stays."""

import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest

from mfvpr.datasets.streets import streets_folder
from mfvpr.features import Sift, VladFitting
from mfvpr.localization import Map
from mfvpr.utils import InputError
from tests.programs import ROOT
from tests.small_disks import UNSHARE, mount, need_small_disks


def fill(disk, street):
    """Add until the disk is full, ask, and go on when it has grown. Prints JSON."""
    from mfvpr.datasets import image_folder

    images, told = image_folder(Path(street) / "database"), []
    mount(disk, "-o", "size=600k")
    known = Map(Path(disk) / "map", Sift(max_keypoints=200, image_size=(160, 120)), VladFitting(num_words=8))
    known.learn(replace(images, names=images.names[:4]))
    for again in (1, 2):
        try:
            for name, path in zip(images.names, images.paths, strict=True):
                if name not in known.names:
                    known.add(path, name, name=name)
        except InputError as error:
            told.append([again, str(error), len(known), known.localize(images.paths[0]).place])
    mount(disk, "-o", "remount,size=20m")
    for name, path in zip(images.names, images.paths, strict=True):
        if name not in known.names:
            known.add(path, name, name=name)
    places = [known.localize(path).place for path in images.paths]
    print(json.dumps({"told": told, "right": places == list(images.names), "number": len(known)}))


@pytest.mark.slow
def test_what_was_added_stays_and_adding_goes_on(tmp_path):
    need_small_disks(tmp_path)
    street = streets_folder(tmp_path / "data", num_frames=12, image_size=(160, 120))
    (tmp_path / "disk").mkdir()
    code = f"from tests.localization.test_full_disk import fill; fill({str(tmp_path / 'disk')!r}, {str(street)!r})"
    found = subprocess.run([*UNSHARE, sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True)
    assert found.returncode == 0, found.stderr
    found = json.loads(found.stdout)
    assert [again for again, *_ in found["told"]] == [1, 2]
    for _, line, number, place in found["told"]:
        assert line.startswith(f"{tmp_path}/disk/map")
        assert "free disk space, got 0.0 MB; free some space and run again" in line
        assert "\n" not in line
        assert 2 <= number < 12
        assert place == "0000.png"
    assert found["told"][0][2] == found["told"][1][2]
    assert found["right"]
    assert found["number"] == 12
