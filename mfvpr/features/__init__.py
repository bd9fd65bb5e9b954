"""Images -> descriptions: what puts OpenCV or a network to work.

An extractor takes a batch of images that were squashed to the size it asks for, so that whoever feeds it (threads that
decode while the device works) need not know what it is. One pass may give a global descriptor of the image, local
features, of one scale or of several, or both. What is computed from local features alone is an aggregation.
"""

from mfvpr.features.extractor import Aggregated, Aggregation, Description, Extractor, Fitting, Scale, Source

__all__ = ["Aggregated", "Aggregation", "Description", "Extractor", "Fitting", "Scale", "Source"]
