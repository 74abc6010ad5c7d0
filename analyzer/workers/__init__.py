"""Workers: this process, several processes of this machine, or a Dask cluster."""

from hearthlog.analyzer.workers.workers import Workers, open_workers

__all__ = ["Workers", "open_workers"]
