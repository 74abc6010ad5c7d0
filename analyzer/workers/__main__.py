"""A worker: `processes.py` starts it."""

from hearthlog.analyzer.workers.processes import serve

if __name__ == "__main__":
    serve()
