__all__ = [
    "Table",
    "claim_run_folder",
    "write_json",
    "write_table",
]

from .runs import claim_run_folder, write_json, write_table
from .tables import Table
