"""Calibrated values written into a site file; comments and order stay."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import tomlkit
from tomlkit.items import InlineTable

from companion.calibration.bearings import BearingFit
from companion.calibration.ranges import Calibration
from companion.calibration.tags import TagBias
from companion.config import config_from_toml
from companion.errors import UserError
from companion.text_file import read_text


def write_range_bias(
    site: Path,
    calibration: Calibration,
    tags: Mapping[int, TagBias],
    bearings: Mapping[int, BearingFit | None],
    to: Path,
) -> None:
    """Put a calibration into the table `[range_bias]` of a site file.

    Args:
        site: file to read.
        calibration: what to write.
        tags: tag id -> bias beyond it.
        bearings: tag id -> what depends on the bearing, None if nothing does; what the file says of others
            stays.
        to: file to write; may be the same.

    Raises:
        UserError: the site file is wrong, or would be with these values, or cannot be written.
    """
    document = tomlkit.parse(read_text(site))
    table = _table(document, "range_bias")
    table["common"] = round(calibration.common, 4)
    table["common_sigma"] = round(calibration.common_sigma, 4)
    anchors = _table(table, "anchors")
    for anchor_id, fit in calibration.anchors.items():
        row = tomlkit.inline_table()
        row["constant"] = round(fit.bias.constant - calibration.common, 4)
        row["constant_sigma"] = round(fit.constant_sigma, 4)
        row["per_metre"] = round(fit.bias.per_metre, 5)
        row["per_metre_sigma"] = round(fit.per_metre_sigma, 5)
        row["distance"] = round(fit.bias.distance, 3)
        anchors[str(anchor_id)] = row
    if tags:
        of_tags = _table(table, "tags")
        for tag_id, bias in tags.items():
            row = tomlkit.inline_table()
            if tag_id not in bearings:
                row.update(of_tags.get(str(tag_id), {}))
            row["constant"] = round(bias.constant, 4)
            row["constant_sigma"] = round(bias.sigma, 4)
            of_bearing = bearings.get(tag_id)
            if of_bearing is not None:
                row["cosine"] = round(of_bearing.bias.cosine, 4)
                row["cosine_sigma"] = round(of_bearing.cosine_sigma, 4)
                row["sine"] = round(of_bearing.bias.sine, 4)
                row["sine_sigma"] = round(of_bearing.sine_sigma, 4)
            of_tags[str(tag_id)] = row
    text = tomlkit.dumps(document)
    config_from_toml(text, str(to), folder=to.parent)
    try:
        to.write_text(text, encoding="utf-8")
    except OSError as error:
        raise UserError(f"cannot write {to}: {error.strerror}") from error


def _table(parent: Any, name: str) -> Any:
    if name not in parent:
        parent[name] = tomlkit.table()
    elif isinstance(parent[name], InlineTable):
        # One line has no room for what a calibration tells.
        whole = tomlkit.table()
        whole.update(parent[name].unwrap())
        parent[name] = whole
    return parent[name]
