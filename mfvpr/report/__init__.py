"""Results for people: tables, figures, pages, and the files of a run folder.

Read first: results (`mfvpr.evaluate`), evaluations and run_files (files of an evaluation), runs (tables and run
folders), searches (sweeps and learning), figures, then pages (HTML).
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
