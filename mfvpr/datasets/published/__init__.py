"""Data sets that others published, each read from the folders it is published in."""

from mfvpr.datasets.published.catalog import PUBLISHED, Published, differences, published_dataset

__all__ = ["PUBLISHED", "Published", "differences", "published_dataset"]
