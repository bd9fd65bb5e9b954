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
from .runs import Table, claim_run_folder, write_json, write_table
