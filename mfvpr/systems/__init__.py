"""Systems from settings: checked values become an extractor, a retrieval, a matcher, scorers and their fusion.

Read first: choices (the settings of each choice, from fields of dataclasses), assembly (settings -> System).
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
