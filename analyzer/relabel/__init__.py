"""Relabelling: layers next to logs, with the labels of another model.

A worker reads the features of a log, and as much of the previous logs as its first labels depend
on, and writes the labels (`layer`). `relabel` submits the logs as jobs, joins segments across log
borders in time order, and completes the layers.
"""
