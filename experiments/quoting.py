"""Settings as they are typed, quoted for Hydra's grammar where it would not take their values."""

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import HydraException

PATHS = {"dataset.database", "dataset.queries", "dataset.root", "dataset.index_file", "dataset.cache"}
PATHS |= {"dataset.database_labels", "dataset.query_labels"}
PATHS |= {"map", "images"}
PATHS |= {"store", "out", "checkpoints", "confidence", "also", "report"}
PATHS |= {f"{group}.{side}" for group in ("features", "retrieval") for side in ("database", "queries")}


def as_typed(argument: str, *, several: bool = False) -> str:
    """A setting quoted for Hydra where its grammar would not take the value as it was typed (paths, mostly).

    Paths may stand in a list; where `several`, in a multirun, between commas.
    """
    name, equals, value = argument.partition("=")
    is_path = name in PATHS and value not in ("", "null") and value[0] not in "'\""
    if not equals or argument.startswith("-") or not (is_path or _unparsable(argument)):
        return argument
    for special in ("\\", "'", "${"):
        value = value.replace(special, f"\\{special}")
    if is_path and value[0] == "[" and value[-1] == "]":
        return f"{name}=[" + ",".join(f"'{one}'" for one in value[1:-1].split(",")) + "]"
    values = value.split(",") if several and is_path else [value]
    return f"{name}=" + ",".join(f"'{one}'" for one in values)


def _unparsable(argument: str) -> bool:
    try:
        OverridesParser.create().parse_override(argument)
    except HydraException:
        return True
    return False
