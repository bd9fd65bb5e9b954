__all__ = [
    "Result",
    "Table",
    "TopPrediction",
    "claim_run_folder",
    "evaluate",
    "write_json",
    "write_table",
]

from .results import Result, TopPrediction, evaluate
from .runs import claim_run_folder, write_json, write_table
from .tables import Table
