"""Programs: a command line becomes settings, settings become values of mfvpr, and a job does the work.

| command | job |
| :-- | :-- |
| evaluate, sweep, learn | evaluation, sweeping, learning |
| map and localize, data, weights, report | localization, published_data, checkpoints, mfvpr.report.pages |

Read first: programs (the command `mfvpr`), schema (settings of the programs), command_line (Hydra), systems
(`load_system`), sweeps (`mfvpr.sweep`). Settings become systems in `mfvpr.systems`; they become the inputs of a job in
inputs, with notes about them. Jobs share run_folder, confidences, console.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
