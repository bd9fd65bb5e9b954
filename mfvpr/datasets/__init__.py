"""Data sets: images, sequences of queries, and the ground truth.

    data = mfvpr.datasets.folder("day/", "night/", ground_truth="order")

Read first: datasets (folders of images), ground_truth and positives (what is correct), image_reading (decoding and
resizing), contents (fingerprints of files), then published (layouts of known data sets) and streets/ (the synthetic
street).
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
