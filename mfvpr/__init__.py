"""Model-free re-ranking for visual place recognition.

Images become features; features become a shortlist and matches; matches become scores; scores become a ranking;
rankings become recall. `evaluate` runs all stages on a data set; `Map` localizes one image at a time. The other names
are the single stages as functions of arrays. The packages add images, files and caches. `value`, `Scorer` and the names
after them are for a scorer of your own; `mfvpr.testing.check_scorer` tests its contract.

`__init__.pyi` lists the names by stage. Each name is imported when it is first used.
"""

from importlib import import_module
from importlib.util import find_spec
from typing import Any

import lazy_loader

__version__ = "0.2.0"

_public_name, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)


def __getattr__(name: str) -> Any:
    """A public name, or a package such as `mfvpr.core`."""
    is_package = name not in __all__ and find_spec(f"{__name__}.{name}") is not None
    return import_module(f"{__name__}.{name}") if is_package else _public_name(name)
