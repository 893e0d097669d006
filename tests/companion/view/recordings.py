"""Rerun recordings read back from their files."""

from pathlib import Path
from typing import Any, TypeAlias

from rerun.chunk import RrdReader

Recording: TypeAlias = dict[str, dict[str, Any]]


def read(path: Path) -> Recording:
    """Entity -> component -> rows of all batches; a static component has one row."""
    entities: Recording = {}
    for chunk in RrdReader(path).stream().to_chunks():
        entity = entities.setdefault(chunk.entity_path.removeprefix("/"), {})
        for name, rows in chunk.to_record_batch().to_pydict().items():
            entity.setdefault(name, []).extend(rows)
    return entities
