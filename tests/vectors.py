"""Test vectors: bytes, and what other people's programs made of them (tests/data/vectors/README.md).

`VECTORS_DIR` names another folder of the same kinds of files; tests find theirs by the files' names.
"""

import json
import os
from pathlib import Path
from typing import Any

import pytest

DIR = Path(os.environ.get("VECTORS_DIR") or Path(__file__).parent / "data" / "vectors")


def stems(*patterns: str) -> list[Any]:
    """Names without ending of the vector files that match; a skipped case when there are none."""
    found = sorted({path.stem for pattern in patterns for path in DIR.glob(f"{pattern}.json")})
    return list(found) or [pytest.param("", marks=pytest.mark.skip(f"no {patterns} in {DIR}"))]


def load(stem: str) -> Any:
    """What the JSON file of that name holds."""
    return json.loads((DIR / f"{stem}.json").read_text(encoding="utf-8"))


def stream(stem: str) -> bytes:
    """The bytes that belong to the JSON file of that name."""
    name: str = load(stem)["stream_file"]
    return (DIR / name).read_bytes()
