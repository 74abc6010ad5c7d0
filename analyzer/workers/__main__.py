"""A worker process, started by `workers.py`."""

from hearthlog.analyzer.workers.workers import serve

if __name__ == "__main__":
    serve()
