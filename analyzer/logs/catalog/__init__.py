"""A catalogue of the logs in a folder: a Parquet file with one row for each of them."""

from hearthlog.analyzer.logs.catalog.catalog import Catalog, CatalogRow, read_catalog

__all__ = ["Catalog", "CatalogRow", "read_catalog"]
