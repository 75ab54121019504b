"""What lies beside the shards: the index of episodes, and the manifest with counts and versions."""

import hashlib
import json
from collections import Counter
from collections.abc import Mapping, Sequence
from io import BytesIO
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from openvima.data.schema import SCHEMA_VERSION

INDEX_NAME = "index.parquet"
MANIFEST_NAME = "dataset.json"
LICENCE = "MIT"

INDEX_SCHEMA = pa.schema(
    [
        pa.field("task", pa.string(), nullable=False),
        pa.field("level", pa.string(), nullable=False),
        pa.field("domain", pa.string(), nullable=False),
        pa.field("seed", pa.int64(), nullable=False),
        pa.field("steps", pa.int32(), nullable=False),
        pa.field("end_effector", pa.string(), nullable=False),
        pa.field("shard", pa.string(), nullable=False),
        pa.field("row", pa.int32(), nullable=False),
        pa.field("content_hash", pa.string(), nullable=False),
    ]
)

Row = Mapping[str, Any]  # Any: one column, one type


def index_bytes(rows: Sequence[Row]) -> bytes:
    """Compose `index.parquet`.

    Args:
        rows: One an episode, with at least the columns of `INDEX_SCHEMA`, in the order of the data set.
    """
    entries = [{name: row[name] for name in INDEX_SCHEMA.names} for row in rows]
    sink = BytesIO()
    pq.write_table(pa.Table.from_pylist(entries, schema=INDEX_SCHEMA), sink, compression="zstd")
    return sink.getvalue()


def manifest_bytes(rows: Sequence[Row], *, config: Mapping[str, Any], versions: Mapping[str, str]) -> bytes:
    """Compose `dataset.json`.

    Args:
        rows: One an episode, with the columns of the index, "redraws" and "skipped".
        config: The settings that decide the content.
        versions: Package name to version.
    """
    manifest = {
        "schema": SCHEMA_VERSION,
        "command": "openvima generate",
        "config": dict(config),
        "versions": dict(versions),
        "licence": LICENCE,
        "content_hash": _joint_hash(rows),
        "counts": {
            "episodes": len(rows),
            "steps": sum(row["steps"] for row in rows),
            "shards": len({row["shard"] for row in rows}),
        },
        "tasks": {
            task: _task_counts([row for row in rows if row["task"] == task])
            for task in sorted({row["task"] for row in rows})
        },
    }
    return (json.dumps(manifest, indent=2, sort_keys=True, ensure_ascii=False) + "\n").encode()


def _joint_hash(rows: Sequence[Row]) -> str:
    joined = "".join(row["content_hash"] for row in rows)
    return hashlib.sha256(joined.encode()).hexdigest()[:32]


def _task_counts(rows: Sequence[Row]) -> dict[str, object]:
    """Episodes kept, seeds tried for them, and what became of the others."""
    skipped = Counter(entry["kind"] for row in rows for entry in row["skipped"])
    num_tried = len(rows) + skipped.total()
    return {
        "episodes": len(rows),
        "steps": sum(row["steps"] for row in rows),
        "seeds_tried": num_tried,
        "success_rate": round(len(rows) / num_tried, 6),
        "redraws": sum(row["redraws"] for row in rows),
        "skipped": dict(sorted(skipped.items())),
    }
