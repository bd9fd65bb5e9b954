"""Questions to a map; answers as lines of JSON."""

import json
import time
from collections.abc import Mapping
from typing import Any

import numpy as np

from experiments import build, confidences, maps
from experiments.answer_figures import AnswerFigures
from experiments.console import tell
from experiments.query_images import images
from experiments.settings import SettingsError
from mfvpr.datasets import read_image
from mfvpr.evaluation import Confidence, read_confidences
from mfvpr.localization import Answer, Asked, Drive, Map, Route
from mfvpr.storage.maps import Entry
from mfvpr.utils import InputError
from mfvpr.utils.files import printable


def localize(settings: dict[str, Any]) -> None:
    """A line for every image as soon as it is answered; one that cannot be read is told in its line."""
    known = maps.opened(
        build.expanded(settings["map"]), confidence=_confidence(settings), threshold=settings["threshold"],
        memory=settings["memory"],
    )  # fmt: skip
    questions, figures, failed = _Questions(known, settings), AnswerFigures(known, settings), 0
    for number, (name, image) in enumerate(images(settings)):
        if number == 0 and len(known):
            tell(f"{len(known):,} images in the map; the first answer takes seconds more: programs compile")
        try:
            pixels = image if isinstance(image, np.ndarray) else read_image(image)
            asked, line = questions.ask(name, pixels)
        except InputError as error:
            if not len(known):
                raise
            failed += 1
            line = {"error": str(error)} | questions.missed()
        else:
            line |= questions.add(name, asked) | figures.draw(number, name, pixels, asked)
        print(printable(json.dumps({"image": name} | line, ensure_ascii=False, allow_nan=False)), flush=True)
    if failed:
        raise SettingsError(f"{failed} of the images could not be answered; their lines say why")
    figures.finish()


class _Questions:
    """One drive: what is asked of the map, and added to it, image by image."""

    def __init__(self, known: Map, settings: Mapping[str, Any]) -> None:
        self._known, self._settings = known, settings
        self._route = None if settings["route"] is None else Route(Drive(advance=settings["route"]))

    def ask(self, name: str, pixels: np.ndarray) -> tuple[Asked, dict[str, Any]]:
        """What the map says, and the line that tells it. What was added before is asked of the map as it was then."""
        start = time.perf_counter()
        row, recent = self._known.row(name) if self._settings["add"] else None, self._settings["recent"]
        asked = self._known.ask(pixels, recent=recent, before=row)
        line = asked.answer.as_json(self._settings["alternatives"]) | self._located(asked.answer, row)
        return asked, line | {"seconds": round(time.perf_counter() - start, 4)}

    def missed(self) -> dict[str, Any]:
        """What the line of an image says that cannot be asked: the robot drives on."""
        return self._located(None, None)

    def add(self, name: str, asked: Asked) -> dict[str, Any]:
        """Whether an image was added now: to the end, unless one of its name is there."""
        if not self._settings["add"]:
            return {}
        features, vector = asked.described
        is_new = self._known.row(name) is None
        if is_new:
            self._known.add_described([Entry(name, name, vector)], [features])
        return {"added": is_new}

    def _located(self, answer: Answer | None, row: int | None) -> dict[str, Any]:
        """Where the route says that the robot is, in rows that an answer may be in."""
        if self._route is None:
            return {}
        there = self._known.there[:row]
        there = there[: max(0, len(there) - self._settings["recent"])]
        found = self._route(answer, there)
        return {"route": found and {"place": self._known.place(found.row), "p": round(found.p, 4)}}


def _confidence(settings: Mapping[str, Any]) -> Confidence | None:
    """That of the map's score."""
    if settings["confidence"] is None:
        return None
    systems, made = read_confidences(build.expanded(settings["confidence"]))
    own = maps.read(build.expanded(settings["map"]))
    name = own["scorer"]["method"]
    if name not in systems:
        raise SettingsError(f"confidence={settings['confidence']}: expected p of {name}, which the map scores by, got "
                            f"{', '.join(systems) or 'none'}; evaluate with the map's settings")  # fmt: skip
    if other := confidences.other_settings(made, name, own):
        tell(f"warning: confidence={settings['confidence']} was fitted with other settings of {', '.join(other)}: p "
             "may mean nothing here")  # fmt: skip
    return systems[name]
