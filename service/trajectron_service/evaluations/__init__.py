"""Batch evaluations: queued, run one after another in processes of their own, kept on disk.

``jobs`` holds the use cases. An evaluation's folder has its plan, the recordings sent along, the
shards of its run and its result; ``store`` has its record. ``worker`` and ``reading`` are what
runs in the other processes, at the lowest priority, so that forecasts keep their latency.
"""
