"""Global descriptors -> a shortlist of candidates for every query.

Read first: search (exact search), retriever (the protocol, search by descriptors, votes, and what is learned from a
database), precomputed (shortlists and descriptors from files).
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
