"""A map that is asked: images with their places, one image as the question, one answer.

    known = Map("map", Sift(), VladFitting())
    known.build(folder, places)            # or, image by image: known.add(image, place)
    answer = known.localize("query.jpg")   # the place, what else it may be, how sure that is, and where to steer

Others may ask a map while one process adds to it.
"""

from mfvpr.maps.answers import Alternative, Answer, Asked
from mfvpr.maps.map import Map

__all__ = ["Alternative", "Answer", "Asked", "Map"]
