"""Signals, threads, processes, and tasks on a cluster: what commands of all kinds share."""
