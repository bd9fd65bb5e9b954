"""Data sets that others published, each read from the folders it is published in."""

from mfvpr.datasets.published.catalog import PUBLISHED, Published, published_dataset, published_differences

__all__ = ["PUBLISHED", "Published", "published_dataset", "published_differences"]
