"""Recordings of moving agents: readers, writers, benchmark splits, evaluation windows."""
