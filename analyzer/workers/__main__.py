"""A worker process, started by `open_workers`."""

from hearthlog.analyzer.workers import serve

if __name__ == "__main__":
    serve()
