"""Model-free re-ranking for visual place recognition.

Images become features; features become a shortlist and matches; matches become scores; scores become a ranking;
rankings become recall. `evaluate` runs all stages on a data set; `Map` localizes one image at a time. The other names
are the single stages as functions of arrays. The packages add images, files and caches. `value`, `Scorer` and the names
after them are for a scorer of your own; `mfvpr.testing.check_scorer` tests its contract.

`__init__.pyi` lists the names by stage. Each name is imported when it is first used.
"""

import lazy_loader

__version__ = "0.2.0"

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
