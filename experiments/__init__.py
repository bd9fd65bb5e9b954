"""The programs: a command line becomes settings, settings become values of mfvpr, and a job does the work.

| command (python -m experiments. ...) | job |
| :-- | :-- |
| evaluate, sweep, learn, localize | evaluation, sweeping, learning, localization |
| map, data, weights, report | maps, published_data, checkpoints, mfvpr.report.pages |
| paper, benchmark | packages of their own |

Settings: command_line (Hydra), overrides, groups, settings and rules (checks), help_text, wording (of errors), declare
(files in conf/ that follow from scorers). Values: build, truth, confidences. Jobs share stages, run_folder, console.
"""
