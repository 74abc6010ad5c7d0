"""A catalogue of the logs in a folder: a Parquet file with one row for each of them."""

from hearthlog.analyzer.logs.catalog.catalog import (
    DAMAGED,
    FINISHED,
    LOG,
    UNFINISHED,
    Catalog,
    Row,
    load_catalog,
    read_catalog,
    write_catalog,
)

__all__ = [
    "DAMAGED",
    "FINISHED",
    "LOG",
    "UNFINISHED",
    "Catalog",
    "Row",
    "load_catalog",
    "read_catalog",
    "write_catalog",
]
