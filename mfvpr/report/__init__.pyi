__all__ = [
    "Table",
    "claimed",
    "write_json",
    "write_table",
]

from .runs import claimed, write_json, write_table
from .tables import Table
