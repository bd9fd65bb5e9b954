"""A map on a disk that is full while images are added: one line of error, and images that were added stay."""

import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest

from mfvpr.datasets import image_folder
from mfvpr.datasets.streets import streets_folder
from mfvpr.features import Sift, VladFitting
from mfvpr.localization import Map
from mfvpr.utils import InputError
from tests.builders import map_system
from tests.programs import ROOT
from tests.small_disks import UNSHARE, mount, need_small_disks


def fill(disk, street):
    """Add images until the disk is full, localize, and go on when it has grown. Prints JSON."""
    images, errors = image_folder(Path(street) / "database"), []
    mount(disk, "-o", "size=600k")
    known = Map(
        Path(disk) / "map", map_system(Sift(max_keypoints=200, image_size=(160, 120)), VladFitting(num_words=8))
    )
    known.learn(replace(images, names=images.names[:4]))

    def add_missing():
        for name, path in zip(images.names, images.paths, strict=True):
            if name not in known.names:
                known.add(path, name, name=name)

    for _ in range(2):
        with pytest.raises(InputError) as error:
            add_missing()
        errors.append([str(error.value), len(known), known.localize(images.paths[0]).place])
    mount(disk, "-o", "remount,size=20m")
    add_missing()
    places = [known.localize(path).place for path in images.paths]
    print(json.dumps({"errors": errors, "are_correct": places == list(images.names), "number": len(known)}))


@pytest.mark.slow
def test_images_stay_and_adding_goes_on(tmp_path):
    need_small_disks(tmp_path)
    street = streets_folder(tmp_path / "data", num_frames=12, image_size=(160, 120))
    (tmp_path / "disk").mkdir()
    code = f"from tests.localization.test_full_disk import fill; fill({str(tmp_path / 'disk')!r}, {str(street)!r})"
    process = subprocess.run([*UNSHARE, sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True)
    assert process.returncode == 0, process.stderr
    report = json.loads(process.stdout)
    for line, number, place in report["errors"]:
        assert line.startswith(f"{tmp_path}/disk/map")
        assert line.endswith("the disk is full; free some space and run again, which goes on from here")
        assert "\n" not in line
        assert 2 <= number < 12
        assert place == "0000.png"
    assert report["errors"][0][1] == report["errors"][1][1]
    assert (report["are_correct"], report["number"]) == (True, 12)
