"""Relabelling: layers beside logs with the labels of another model.

Each log is a job: a worker reads its features, and as much of the logs before it as its first
labels depend on, and writes the labels (`layer`). Segments that lie in several logs are then
joined, in the order of time, and the layers are completed. `relabel` hands out the jobs.
"""
