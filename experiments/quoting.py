"""Quote typed settings whose values Hydra's grammar would reject."""

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import HydraException

PATHS = {"dataset.database", "dataset.queries", "dataset.root", "dataset.index_file", "dataset.cache"}
PATHS |= {"dataset.database_labels", "dataset.query_labels", "map", "images"}
PATHS |= {"cache", "out", "checkpoints", "confidence", "also", "report"}
PATHS |= {f"{group}.{side}" for group in ("features", "retrieval") for side in ("database", "queries")}


def as_typed(argument: str, *, several: bool = False) -> str:
    """Quote the value of a typed setting if Hydra's grammar would reject it (paths, mostly).

    Paths may stand in a list; if `several`, in a multirun, also between commas.
    """
    name, equals, value = argument.partition("=")
    is_path = name in PATHS and value not in ("", "null") and value[0] not in "'\""
    if not equals or argument.startswith("-") or not (is_path or _unparsable(argument)):
        return argument
    for special in ("\\", "'", "${"):
        value = value.replace(special, f"\\{special}")
    is_list = is_path and value[0] == "[" and value[-1] == "]"
    if is_list:
        value = value[1:-1]
    parts = value.split(",") if is_list or (several and is_path) else [value]
    quoted = ",".join(f"'{part}'" for part in parts)
    return f"{name}=[{quoted}]" if is_list else f"{name}={quoted}"


def _unparsable(argument: str) -> bool:
    try:
        OverridesParser.create().parse_override(argument)
    except HydraException:
        return True
    return False
