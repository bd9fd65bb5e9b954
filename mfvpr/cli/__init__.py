"""Programs: a command line becomes settings, settings become values of mfvpr, and a job does the work.

Read first: programs (the command `mfvpr`), schema (settings of the programs), command_line (Hydra, `load_system`),
jobs (what jobs share). The jobs are evaluation, sweeping (also `mfvpr.sweep`), learning, localization, commands.
"""
