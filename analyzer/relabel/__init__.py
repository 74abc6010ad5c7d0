"""Logs labelled anew by a model, in layers beside them.

A log is a task: a worker reads its features, and as much of the logs before it as its first frames
need, and writes the labels of every frame (`labels`). Where a segment lies in several logs, its
parts are then put together, in the order of time, and the layer is completed (`layer`). `run` hands
out the tasks; `neighbours` knows which log comes before which.
"""
