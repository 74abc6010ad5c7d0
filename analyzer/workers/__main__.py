"""A worker process, started by `processes.py`."""

from hearthlog.analyzer.workers.processes import serve

if __name__ == "__main__":
    serve()
