"""One finished episode of a recording, in a file of its own until the dataset is written."""

import json
from collections.abc import Sequence
from pathlib import Path

import pyarrow as pa

from astra_data.core.errors import CorruptDatasetError, in_short
from astra_data.dataset.columns import Column, Episode
from astra_data.dataset.digests import digest_of
from astra_data.dataset.parquet import to_arrow, to_numpy


def write_staged(path: Path, episode: Episode, schema: pa.Schema) -> None:
    """Write the columns of `schema`, with their digests, uid and metadata.

    Raises:
        OSError: the file cannot be written.
    """
    facts = {
        "uid": episode.uid,
        "metadata": dict(episode.metadata),
        "digests": {name: digest_of(episode.columns[name]) for name in schema.names},
    }
    arrays = [to_arrow(episode.columns[field.name], field.type) for field in schema]
    schema = schema.with_metadata({"episode": json.dumps(facts)})
    with path.open("wb") as sink, pa.ipc.new_file(sink, schema) as file:
        file.write_table(pa.Table.from_arrays(arrays, schema=schema))


def load_staged(path: Path, columns: Sequence[Column]) -> Episode:
    """Return the episode in the file at `path`.

    Raises:
        CorruptDatasetError: the file cannot be read, or has other values than were written.
    """
    try:
        if not path.is_file():
            raise OSError("it is no file")
        with pa.memory_map(str(path)) as source, pa.ipc.open_file(source) as file:
            table = file.read_all()
            facts = json.loads(table.schema.metadata[b"episode"])
            values = {c.name: to_numpy(table.column(c.name), c.size, c.dtype) for c in columns}
            uid, metadata, digests = facts["uid"], facts["metadata"], facts["digests"]
            altered = [name for name, digest in digests.items() if digest_of(values[name]) != digest]
    except (OSError, pa.ArrowException, AttributeError, KeyError, TypeError, ValueError) as error:
        raise CorruptDatasetError(
            f"{path} is no whole episode ({in_short(error)}); delete it and resume the recording."
        ) from error
    if altered:
        raise CorruptDatasetError(
            f"{path} was altered in {', '.join(altered)}; delete it and resume the recording."
        )
    return Episode(uid, values, metadata)
