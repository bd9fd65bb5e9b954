"""Which images gave a shard nothing, and why: so that others do not wait for them."""

import json
from collections.abc import Mapping

from mfvpr.storage.disk import told
from mfvpr.storage.places import SHARDS
from mfvpr.storage.rows import RowStore
from mfvpr.utils.errors import InputError
from mfvpr.utils.files import write_text

BAD = "bad.json"


def leave_bad(store: RowStore, bad: Mapping[int, str]) -> None:
    """Reasons by row, of the shard that writes into a store."""
    with told(store.folder, store.kind.content):
        write_text(store.own / BAD, json.dumps({str(row): reason for row, reason in sorted(bad.items())}))


def known_bad(store: RowStore) -> dict[int, str]:
    """Reasons by row, of all shards.

    Raises:
        InputError: a file is damaged.
    """
    found: dict[int, str] = {}
    with told(store.folder, store.kind.content):
        for path in sorted((store.folder / SHARDS).glob(f"*-of-*/{BAD}")):
            try:
                found |= {int(row): str(reason) for row, reason in json.loads(path.read_text("utf-8")).items()}
            except (ValueError, AttributeError):
                raise InputError(f"{path}: expected reasons by row, got something else; delete this file, and run "
                                 "again") from None  # fmt: skip
    return found
