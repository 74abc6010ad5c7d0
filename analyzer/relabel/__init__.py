"""Relabelling: layers next to logs, with the labels of another model.

Each log is a job: a worker reads its features and as much of the previous logs as its first
labels depend on, and writes the labels (`layer`). Segments that cross log borders are then
joined in time order, and the layers are completed. `relabel` submits the jobs.
"""
