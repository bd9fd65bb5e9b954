"""Features of two images -> Matches; features of many images -> sets of matches.

Read first: nearest_neighbors (one pair), matcher (matchers as values), similarity (the product), checked (products in
bfloat16), soft, lightglue; then batched (whole shortlists) and match_set (matches of many queries).
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
