"""Localization: a map of images with known places, in which one image at a time is localized.

    known = Map.create("map", folder, system)  # then Map.open("map"); image by image: known.add(image, place)
    prediction = known.localize("query.jpg")   # place, alternatives, confidence, and the shift for steering
    route = Route(Drive())                 # if the map and the queries are in the order of a drive:
    located = route(prediction, known.there)   # the row that is most probable given all images so far and the motion

Other processes may read a map while one process adds to it, and several threads may share one `Map`.

Read first: map (images of a map, how they are added, and how one is localized: add a step to `Map._localize`),
query_steps, map_settings, predictions, route (a drive through a map).
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
