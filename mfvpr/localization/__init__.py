"""A map that is asked: images with their places, one image as the question, one answer.

    known = Map("map", Sift(), VladFitting())
    known.build(folder, places)            # or, image by image: known.add(image, place)
    answer = known.localize("query.jpg")   # the place, what else it may be, how sure that is, and where to steer
    route = Route(Drive(advance=1))        # of images in the order of a drive, of a map in the order of one as well:
    located = route(answer, known.there)   # the row that the images before, this one and the motion say together

Other processes may ask a map while one process adds to it, and several threads may share one `Map`.

Read first: map, answers, then what it uses: describing, vectors, matching, resident (features in memory), evidence (too
few features or matches), shifts, route (a drive through a map).

Imports datasets, evaluation, features, matching, reranking, scoring, storage, types, utils.
"""

from mfvpr.localization.answers import Alternative, Answer, Asked
from mfvpr.localization.map import Map
from mfvpr.localization.route import Drive, Located, Route

__all__ = ["Alternative", "Answer", "Asked", "Drive", "Located", "Map", "Route"]
